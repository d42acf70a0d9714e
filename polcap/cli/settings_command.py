"""`polcap settings`: every setting with its default, range and meaning."""

import textwrap
from json import dumps as to_json
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from polcap import terminal
from polcap.cli.options import Json
from polcap.errors import SettingError

if TYPE_CHECKING:
    from polcap.config import Setting


def settings(
    stage: Annotated[
        str | None, Argument(metavar="[STAGE]", help="Only this stage, such as hdr, gates or fusion; or synth.")
    ] = None,
    json: Json = False,
) -> None:
    """List the settings of all stages with default, range and meaning; --set and --config take them."""
    from polcap.formats import text_file
    from polcap.material.material_path import all_settings

    rows = _synth_settings() if stage == "synth" else all_settings()
    stages = dict.fromkeys(row.key.partition(".")[0] for row in rows)
    if stage not in (None, "synth", *stages):
        raise SettingError(f"settings {stage}: no such stage; {text_file.suggestion(str(stage), [*stages, 'synth'])}")
    found, lines = [], []
    for row in rows:
        if stage in (None, "synth", row.key.partition(".")[0]):
            choices = row.kind.removeprefix("Literal[").strip("]").replace("'", "")
            limits = choices if row.kind.startswith("Literal") else row.limits
            found.append({"name": row.key, "default": row.default, "range": limits, "meaning": row.description})
            default = row.default if isinstance(row.default, str) else to_json(row.default)
            lines.append(f"{row.key} = {'unset' if row.default is None else default}{limits and f'  ({limits})'}")
            lines.append(textwrap.indent(textwrap.fill(row.description, 96), "    "))
    terminal.print_data(found if json else "\n".join(lines))


def keys_named(option: str, command: str) -> list[str]:
    """Keys of the settings of a command whose last part is the name of an option that does not exist."""
    from polcap import config
    from polcap.material.material_path import all_settings

    several = all_settings() if command in ("fuse", "material") else config.settings()
    rows, name = _synth_settings() if command == "synth" else several, option.lstrip("-").replace("-", "_")
    return list(dict.fromkeys(row.key for row in rows if row.key.rpartition(".")[2] == name))


def _synth_settings() -> "list[Setting]":
    """The settings of `polcap synth`, then those that its options --views, --flat and --calibration change or add."""
    from msgspec import Struct

    from polcap import config
    from polcap.synth.all_around import AroundShoot
    from polcap.synth.calibration_frames import CalibrationShoot
    from polcap.synth.flat_views import FlatShoot
    from polcap.synth.shooting import Shoot

    rows, seen = list(config.settings(Shoot)), list(config.settings(Shoot))
    kinds: dict[str, type[Struct]] = {
        "--views": AroundShoot, "--flat": FlatShoot, "--calibration": CalibrationShoot,
    }  # fmt: skip
    for option, kind in kinds.items():
        new = [row for row in config.settings(kind) if row not in seen]
        seen += new
        rows += [row._replace(description=f"with {option}: {row.description}") for row in new]
    return rows
