"""Settings of a run: from defaults, a TOML file and `--set` assignments; later ones override earlier ones.

Each stage declares its own settings; `Config` has a section for each stage with settings, and one for the gates. An
unknown key or a value out of range is an error that names the key, the value and the limit.
"""

import difflib
import functools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from polcap.errors import SettingError, StorageError
from polcap.formats import text_file
from polcap.quality.limits import GateLimits
from polcap.stages.align import AlignSettings
from polcap.stages.asset import AssetSettings
from polcap.stages.hdr import HdrSettings
from polcap.stages.infer import InferSettings
from polcap.stages.mask import MaskSettings
from polcap.stages.selfcal import SelfcalSettings
from polcap.stages.stokes import StokesSettings
from polcap.stages.surface import SurfaceSettings
from polcap.stages.whitebalance import WhitebalanceSettings

S = TypeVar("S", bound=msgspec.Struct)

_BARE_POINT = re.compile(r"(?<![\w.])\.(?=\d)")  # of a number without a leading 0


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All settings of a run: a section for each stage with settings, and one for the gates."""

    hdr: HdrSettings = HdrSettings()
    whitebalance: WhitebalanceSettings = WhitebalanceSettings()
    align: AlignSettings = AlignSettings()
    mask: MaskSettings = MaskSettings()
    selfcal: SelfcalSettings = SelfcalSettings()
    stokes: StokesSettings = StokesSettings()
    infer: InferSettings = InferSettings()
    surface: SurfaceSettings = SurfaceSettings()
    asset: AssetSettings = AssetSettings()
    gates: GateLimits = GateLimits()

    @property
    def of_views(self) -> "Config":
        """The settings of a single view: a subclass's sections for several views are left out."""
        return msgspec.convert(self, Config, from_attributes=True)


class Setting(NamedTuple):
    """One row of the settings reference: key, type, default, limits and meaning."""

    key: str
    kind: str
    default: Any
    limits: str
    description: str


def load(file: Path | None = None, assignments: Sequence[str] = ()) -> Config:
    """Settings of a run from a TOML file and assignments such as "hdr.clip=0.95".

    Raises SettingError: the file cannot be read, or a name or value is wrong.
    """
    return fill(Config, read(file), assignments)


def read(file: Path | None) -> dict[str, Any]:
    """Read a TOML file of settings; empty without a file. Raises SettingError: it cannot be read, or is not TOML."""
    try:
        return {} if file is None else text_file.read_toml(file)
    except OSError as error:
        raise SettingError(f"--config {file}: {error.strerror or error}") from error
    except ValueError as error:
        raise SettingError(f"--config {file} is not TOML: {error}") from error


def fill(kind: type[S], stated: Mapping[str, Any], assignments: Sequence[str]) -> S:
    """Fill a struct of settings from a table and from assignments of the form name=value or section.name=value.

    Raises SettingError: a key is unknown, of the wrong type or out of its range.
    """
    setting_of = {setting.key: setting for setting in settings(kind)}
    values = dict(_by_key(stated))
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals:
            raise SettingError(f"--set {assignment}: give a value, as in {next(iter(setting_of))}=VALUE")
        values |= _by_key({key.strip(): _parse(text.strip())})
    _check_plain(values)
    table: dict[str, Any] = {}
    for key, value in values.items():
        _check_known(key, value, setting_of)
        *sections, name = key.split(".")
        # the innermost of the tables that are named by the sections gets the value
        functools.reduce(lambda inner, section: inner.setdefault(section, {}), sections, table)[name] = value
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        fault = text_file.fault(error, table, kind)
        meaning = next((one.description for key, one in setting_of.items() if re.match(rf"{key}\b", fault)), "")
        raise SettingError(f"{fault} ({meaning})" if meaning else fault) from error
    except UnicodeError as error:
        raise SettingError("--set: a value is not UTF-8 text; write it in ASCII") from error


def restore(kind: type[S], about: Mapping[str, Any], file: Path) -> S:
    """Settings of an earlier run, from `about`, the content of its file.

    Raises StorageError: the settings are missing or belong to another version of polcap.
    """
    try:
        return msgspec.convert(about["settings"], kind)
    except (msgspec.ValidationError, KeyError) as error:
        raise StorageError(f"{file}: its settings are of another polcap ({error}); run `polcap process`") from error


def settings(kind: type[msgspec.Struct] = Config, prefix: str = "") -> Iterator[Setting]:
    """All settings of a struct of sections, in the order of the stages, for the settings reference."""
    annotated, plain = get_type_hints(kind, include_extras=True), get_type_hints(kind)
    for field in msgspec.structs.fields(kind):
        key, hint, type_ = f"{prefix}{field.name}", annotated[field.name], plain[field.name]
        if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
            yield from settings(type_, f"{key}.")
            continue
        members = [hint] if get_origin(hint) is Annotated else [*get_args(hint)] or [hint]  # of a union with None
        metas = [extra for member in members for extra in get_args(member)[1:] if isinstance(extra, Meta)]
        choices = get_origin(type_) is Literal
        # of a union with None or of a tuple, the first member
        type_name = str(type_).replace("typing.", "") if choices else (*get_args(type_), type_)[0].__name__
        description = "".join(meta.description or "" for meta in metas)
        yield Setting(key, type_name, field.default, ", ".join(filter(None, map(_limits, metas))), description)


def _limits(meta: Meta) -> str:  # such as ≥ 0, ≤ 1
    signs = {"gt": "> ", "ge": "≥ ", "lt": "< ", "le": "≤ ", "multiple_of": "multiple of "}
    return ", ".join(f"{sign}{getattr(meta, name)}" for name, sign in signs.items() if getattr(meta, name) is not None)


def _by_key(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys such as hdr.clip and values of nested tables."""
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield from _by_key(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _parse(text: str) -> Any:
    """Parse a setting's value as TOML; also words without quotes, lists without brackets (0,60,120) and .5 for 0.5."""
    for candidate in (text, f"[{text}]" if "," in text else text, _BARE_POINT.sub("0.", text)):
        try:
            return tomllib.loads(f"value = {candidate}")["value"]
        except (ValueError, RecursionError):
            continue
    return text


def _check_plain(stated: dict[str, Any]) -> None:
    """Refuse NaN and infinity, which pass every range check, and NUL characters."""
    try:
        text_file.check_plain(stated)
    except ValueError as error:
        raise SettingError(f"{error}; correct it") from error


def _check_known(key: str, value: Any, known: dict[str, Setting]) -> None:
    """Raise SettingError for an unknown key, with the most similar one."""
    if key in known or (value == {} and any(name.startswith(f"{key}.") for name in known)):
        return
    similar = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    sections = dict.fromkeys(name.partition(".")[0] for name in known)
    hint = f"; did you mean {similar[0]}?" if similar else f"; there are {', '.join(sections)}"
    raise SettingError(f"{key} = {value!r}: there is no such setting{hint}")
