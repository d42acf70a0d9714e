"""In: a TOML file and `--set` assignments. Out: one frozen `Config`, a section per stage.

Defaults < file < assignments. Strict: an unknown key or a value out of range is an error that
names it, its value and its limit. The settings themselves stand in the stages that use them.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from polcap.errors import SettingError, StorageError
from polcap.formats import text_file
from polcap.stages.align import Settings as Align
from polcap.stages.asset import AssetSettings
from polcap.stages.hdr import Settings as Hdr
from polcap.stages.infer import InferSettings
from polcap.stages.mask import MaskSettings
from polcap.stages.selfcal import SelfcalSettings
from polcap.stages.stokes import StokesSettings
from polcap.stages.surface import SurfaceSettings
from polcap.stages.whitebalance import WhitebalanceSettings

S = TypeVar("S", bound=msgspec.Struct)

_BARE_POINT = re.compile(r"(?<![\w.])\.(?=\d)")  # of a number written without its 0


class Gates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a capture must keep to: beyond, `check` says reshoot, and `process` writes the asset and ends with 3."""

    max_delta_e: Annotated[float, Meta(gt=0, description="mean residual of the chart [CIEDE2000]")] = 5.0
    max_tone_curvature: Annotated[
        float, Meta(gt=0, le=1, description="change of an exposure ratio with brightness, ln over ln; 0 is linear [1]")
    ] = 0.1
    max_gain_disagreement: Annotated[
        float,
        Meta(gt=0, le=1, description="chart against object on a shot's light beyond both errors; 1 % costs 6° [1]"),
    ] = 0.03
    max_gain_doubt: Annotated[
        float, Meta(gt=0, le=1, description="1σ of a shot's light, or of the chart's gloss on it; 1 % is 6° [1]")
    ] = 0.006
    max_gain_change: Annotated[
        float, Meta(gt=0, le=1, description="of a shot's light against the other shots'; more is no ordinary pop [1]")
    ] = 0.1
    max_energy_drift: Annotated[
        float, Meta(gt=0, le=1, description="of one frame's light against its shot's and the other brackets' [1]")
    ] = 0.06
    max_align_residual_px: Annotated[
        float, Meta(gt=0, description="estimated 1σ error of a shot's registration [px of the grid]")
    ] = 0.15
    max_object_shift_px: Annotated[
        float,
        Meta(gt=0, description="of the object against its surroundings, shot to shot [px of the processed picture]"),
    ] = 1.5
    max_mask_doubt: Annotated[
        float, Meta(ge=0, le=1, description="1 − the overlap with the truth that the network expects; half warns [1]")
    ] = 0.25
    max_mask_islands: Annotated[
        float, Meta(ge=0, le=1, description="share of the object outside its largest part, to pass unnoticed [1]")
    ] = 0.02
    max_mask_holes: Annotated[
        float, Meta(ge=0, le=1, description="area of the object's holes, of its own, to pass unnoticed [1]")
    ] = 0.05
    max_mask_border: Annotated[
        float, Meta(ge=0, le=1, description="share of the picture's edge on the object, to pass unnoticed [1]")
    ] = 0.0
    max_clipped: Annotated[float, Meta(ge=0, le=1, description="share of the object that is clipped [1]")] = 0.02
    max_blur_px: Annotated[
        float,
        Meta(gt=0, le=20, description="1σ beyond the sharpest shot's; 0.6 px of the merged picture [RAW px]"),
    ] = 1.2
    max_turn_deg: Annotated[
        float,
        Meta(ge=3, le=45, description="of the polarizer away from the stated angle, told by the outline [degrees]"),
    ] = 8.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(gt=0, le=45, description="of the ring's zero, by three angles: it may be a single shot's [degrees]"),
    ] = 3.0
    max_turn_fit: Annotated[
        float, Meta(gt=0, lt=1, description="misfit of the outline with that turn over without, to be believed [1]")
    ] = 0.68
    min_outline_dolp: Annotated[
        float, Meta(ge=0, le=1, description="median polarization of the outline; less is no common body [1]")
    ] = 0.03
    min_zenith_deg: Annotated[
        float,
        Meta(ge=0, le=90, description="median zenith of a weakly polarized shape; less is flattened [degrees]"),
    ] = 33.0
    max_inward_outline: Annotated[
        float, Meta(ge=0, le=1, description="share of the outline's normals that point into the object [1]")
    ] = 0.06
    min_concentration: Annotated[
        float, Meta(ge=0, le=1, description="how well polarization follows the outline, 1 is all round [1]")
    ] = 0.5
    max_one_sided: Annotated[
        float, Meta(gt=0, description="light of the outline going once round it, against its mean [1]")
    ] = 0.4
    max_side_light: Annotated[
        float, Meta(gt=0, le=1, description="one side of the outline brighter in one shot than in the others [1]")
    ] = 0.07
    max_dolp_noise: Annotated[
        float, Meta(gt=0, le=1, description="polarization that noise fakes in the object's median pixel [1]")
    ] = 0.04
    max_ambient: Annotated[
        float, Meta(gt=0, le=1, description="share of the light that is there without the flash [1]")
    ] = 0.1
    max_crossed_misfit: Annotated[
        float, Meta(gt=0, le=1, description="share of the object brighter in the cross-polarised shot than in S0 [1]")
    ] = 0.05
    max_ill_posed: Annotated[
        float, Meta(ge=0, le=1, description="share of the object whose DoLP no dielectric can have [1]")
    ] = 0.05
    max_ghost: Annotated[
        float, Meta(ge=0, le=1, description="share of a shot whose exposures disagree beyond noise [1]")
    ] = 0.02
    max_normal_error_deg: Annotated[
        float, Meta(gt=0, le=90, description="median expected error of the normals [degrees]")
    ] = 20.0
    max_mesh_pieces: Annotated[int, Meta(ge=1, description="pieces of the seen surface, without specks")] = 10
    max_mesh_cuts: Annotated[
        float, Meta(ge=0, description="length of the cuts where depth jumps, both sides, over the outline's [1]")
    ] = 2.0
    max_mesh_raggedness: Annotated[
        float, Meta(ge=0, description="how much longer the mesh's rim is than its smooth curve [1]")
    ] = 0.25


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Every setting of a run."""

    hdr: Hdr = Hdr()
    whitebalance: WhitebalanceSettings = WhitebalanceSettings()
    align: Align = Align()
    mask: MaskSettings = MaskSettings()
    selfcal: SelfcalSettings = SelfcalSettings()
    stokes: StokesSettings = StokesSettings()
    infer: InferSettings = InferSettings()
    surface: SurfaceSettings = SurfaceSettings()
    asset: AssetSettings = AssetSettings()
    gates: Gates = Gates()


class Setting(NamedTuple):
    """One row of the settings page."""

    key: str
    kind: str
    default: Any
    limits: str
    description: str


def load(file: Path | None = None, assignments: Sequence[str] = ()) -> Config:
    """Read the settings of a run.

    Raises
    ------
    SettingError
        The file is not TOML, or a key is unknown, of the wrong type or out of its range.
    """
    stated = _read(file) if file else {}
    for section, values in stated.items():
        if not isinstance(values, dict):
            raise SettingError(f"{file}: `{section}` is not a section; write [stage] and below it name = value")
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        section, dot, name = key.strip().partition(".")
        if not equals or not dot:
            raise SettingError(f"--set {assignment}: not of the form stage.name=value, as in hdr.clip=0.95")
        stated.setdefault(section, {})[name] = _parse(text.strip())
    _check_finite(stated)
    known = {setting.key: setting for setting in settings()}
    for section, values in stated.items():
        for name, value in values.items():
            _check_known(f"{section}.{name}", value, known)
    try:
        return msgspec.convert(stated, Config)
    except msgspec.ValidationError as error:
        raise _explain(error, stated, known) from error
    except UnicodeError as error:
        raise SettingError("--set: a value is no UTF-8 text; write it in ASCII") from error


def restored(about: Mapping[str, Any], file: Path) -> Config:
    """The settings that a file of an earlier run tells.

    Raises
    ------
    StorageError
        They are those of another polcap, or no settings.
    """
    try:
        return msgspec.convert(about["settings"], Config)
    except (msgspec.ValidationError, KeyError) as error:
        raise StorageError(f"{file}: its settings are not this polcap's ({error}); run `polcap process`") from error


def fill(kind: type[S], stated: dict[str, Any], assignments: Sequence[str]) -> S:
    """A single struct from given values and name=value assignments, as strict as `load`.

    Raises
    ------
    SettingError
        No such name, or a value of another type or outside its range.
    """
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or name not in kind.__struct_fields__:
            near = difflib.get_close_matches(name, kind.__struct_fields__, n=1, cutoff=0.5) if equals else []
            hint = (
                f"did you mean {near[0]}?" if near else f"give one of {', '.join(kind.__struct_fields__)} as name=value"
            )
            raise SettingError(f"--set {assignment}: {hint}")
        stated = {**stated, name: _parse(text.strip())}
    _check_finite(stated)
    try:
        return msgspec.convert(stated, kind)
    except msgspec.ValidationError as error:
        raise SettingError(f"--set {text_file.fault(error, stated, kind)}") from error


def settings() -> Iterator[Setting]:
    """Every setting in the order of the stages, as the settings page lists them."""
    for section in msgspec.structs.fields(Config):
        hints = get_type_hints(section.type, include_extras=True)
        for field in msgspec.structs.fields(section.type):
            hint = hints[field.name]
            arms = [hint] if get_origin(hint) is Annotated else [*get_args(hint)] or [hint]
            meta = next((extra for arm in arms for extra in get_args(arm)[1:] if isinstance(extra, Meta)), Meta())
            kind = get_type_hints(section.type)[field.name]
            word = str(kind).replace("typing.", "") if get_args(kind) else kind.__name__
            yield Setting(f"{section.name}.{field.name}", word, field.default, _limits(meta), meta.description or "")


def _limits(meta: Meta) -> str:
    signs = {"gt": "> ", "ge": "≥ ", "lt": "< ", "le": "≤ ", "multiple_of": "multiple of "}
    return ", ".join(f"{sign}{getattr(meta, name)}" for name, sign in signs.items() if getattr(meta, name) is not None)


def _read(file: Path) -> dict[str, Any]:
    try:
        return text_file.read_toml(file)
    except OSError as error:
        raise SettingError(f"--config {file}: {error.strerror or error}") from error
    except ValueError as error:
        raise SettingError(f"--config {file} is not TOML: {error}") from error


def _parse(text: str) -> Any:
    """A TOML value; a bare word is a string, what has commas outside brackets is a list (0,60,120), .5 is a number."""
    for written in (text, f"[{text}]" if "," in text else text, _BARE_POINT.sub("0.", text)):
        try:
            return tomllib.loads(f"value = {written}")["value"]
        except (ValueError, RecursionError):
            continue
    return text


def _check_finite(stated: dict[str, Any]) -> None:
    """No limit of a setting stops a NaN."""
    try:
        text_file.check_finite(stated)
    except ValueError as error:
        raise SettingError(f"{error}; give a number") from error


def _check_known(key: str, value: Any, known: dict[str, Setting]) -> None:
    if key in known:
        return
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else f"; sections are {', '.join(Config.__struct_fields__)}"
    raise SettingError(f"{key} = {value!r}: there is no such setting{hint}")


def _explain(error: msgspec.ValidationError, stated: dict[str, Any], known: dict[str, Setting]) -> SettingError:
    message, _, path = str(error).partition(" - at `$.")
    key = path.rstrip("`").split("[")[0]
    section, _, name = key.partition(".")
    value = stated.get(section, {}).get(name)
    about = known[key].description if key in known else ""
    if message.startswith("Invalid enum value"):
        message = f"not one of {known[key].kind.removeprefix('Literal').strip('[]')}"
    return SettingError(f"{key} = {value!r}: {message[:1].lower()}{message[1:]} ({about})")
