"""`polcap settings`: every setting with its default, range and meaning."""

import textwrap
from json import dumps as to_json
from typing import Annotated

from typer import Argument, Context

from polcap import terminal
from polcap.cli.options import Json
from polcap.errors import SettingError


def settings(
    context: Context,
    stage: Annotated[
        str | None, Argument(metavar="[STAGE]", help="Only this stage, such as hdr, gates or fusion.")
    ] = None,
    json: Json = False,
) -> None:
    """List the settings of all stages with default, range and meaning; --set and --config take them."""
    from polcap.formats import text_file
    from polcap.material.material_path import all_settings

    rows = all_settings()
    stages = dict.fromkeys(row.key.partition(".")[0] for row in rows)
    if stage is not None and stage not in stages:
        raise SettingError(f"settings {stage}: no such stage; {text_file.suggestion(stage, stages)}")
    found, lines = [], []
    for row in rows:
        if stage in (None, row.key.partition(".")[0]):
            choices = row.kind.removeprefix("Literal[").strip("]").replace("'", "")
            limits = choices if row.kind.startswith("Literal") else row.limits
            found.append({"name": row.key, "default": row.default, "range": limits, "meaning": row.description})
            default = row.default if isinstance(row.default, str) else to_json(row.default)
            lines.append(f"{row.key} = {'unset' if row.default is None else default}{limits and f'  ({limits})'}")
            lines.append(textwrap.indent(textwrap.fill(row.description, 96), "    "))
    terminal.print_data(found if json else "\n".join(lines))
