"""Write the reference pages that are generated from the code: settings, options of the commands, Python interface.

python docs/make_reference.py
"""

import ast
import inspect
import re
from itertools import groupby
from pathlib import Path

from typer.main import get_command

import polcap
from polcap.cli import app
from polcap.fusion.fusion_path import WITHOUT_EFFECT
from polcap.material.material_path import all_settings

REFERENCE = Path(__file__).parent / "reference"
_OPTIONS = re.compile(r"(<!-- options of (\w+) -->\n).*?(<!-- end -->)", re.S)
_MADE = "<!-- made by docs/make_reference.py; do not edit -->"


def pages() -> dict[Path, str]:
    """The text of each page, by its path."""
    commands = REFERENCE / "commands.md"
    filled = _OPTIONS.sub(lambda m: f"{m[1]}{options_table(m[2])}\n{m[3]}", commands.read_text(encoding="utf-8"))
    return {
        commands: filled,
        REFERENCE / "settings.md": settings_page(),
        REFERENCE / "api.md": api_page(),
    }


def options_table(command_name: str) -> str:
    """Table of the arguments and options of a command, from its --help."""
    command = get_command(app).commands[command_name]  # type: ignore[attr-defined]
    context = command.make_context(command_name, [], resilient_parsing=True)
    rows = [record for one in command.params if (record := one.get_help_record(context))]
    lines = ["| option | meaning |", "| --- | --- |"]
    for option, meaning in rows:  # a | inside `…` would end the cell
        lines.append(f"| `{option.replace('|', '/')}` | {' '.join(meaning.split()).replace('|', '&#124;')} |")
    return "\n".join(lines)


def settings_page() -> str:
    """The page of all settings with type, default, range and meaning."""
    without = [f"`{key}…`" if key.endswith(".") else f"`{key}`" for key in WITHOUT_EFFECT]
    lines = [
        "# Settings", "", _MADE, "",
        "This page lists all settings. `--config FILE.toml` (sections as below) overrides the defaults;",
        "`--set stage.name=value` overrides both.",
        "An unknown name or a value outside its range is an error that names it.",
        "The unit [1] is a share, a ratio or another pure number; a merged px is 2×2 RAW px by default (X-Trans 3×3).",
        "In a file, `fusion.shape.grid` is `grid` below `[fusion.shape]`. Only `polcap material` takes `material.…`,",
        "only `polcap fuse` takes `fusion.…`;",
        f"it refuses {', '.join(without)}, which would not change a fused object.", "",
    ]  # fmt: skip
    for name, rows in groupby(all_settings(), lambda setting: setting.key.partition(".")[0]):
        lines += ["", f"## {name}", "", "| setting | type | default | range | meaning [unit] |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for row in rows:
            kind = row.kind.removeprefix("Literal").strip("[]")
            default = "unset" if row.default is None else f"`{row.default}`"
            lines.append(f"| `{row.key}` | {kind} | {default} | {row.limits or '–'} | {row.description} |")
    return "\n".join(lines) + "\n"


def api_page() -> str:
    """The page of public functions, with signature and docstring, and of public values, with their source."""
    lines = [
        "# From Python", "", _MADE, "",
        "This page is for programs that call polcap.", "",
        "```python", "import polcap", "", 'result = polcap.process("CAPTURE")', "print(result.verdict)",
        "maps = polcap.read_maps(result.folder)", "print(maps.normal.shape, maps.depth.shape)", "```", "",
        "`examples/from_python.py` is a complete program. Names are imported at their first use. The package is typed.",
        "",
        "**Single stages.** `examples/stage_by_stage.py` calls the stages one after the other and uses their values.",
        "`reopen` reads the values that an earlier `process` stored in a result folder: `radiance`, `color`,",
        "`alignment`, `object_`, `selfcal`, `stokes`, `cues`, `maps`, `mesh`. They are read-only arrays, and",
        "`polcap clean` removes them. The values and the calls of stages may change between versions.", "",
        "```python", "from polcap.pipeline.run import reopen", "from polcap.results import Results", "",
        'results, facts = reopen("CAPTURE/polcap", Results)',
        "print(results.stokes.stokes.shape, results.cues.dolp.shape, results.maps.normal.shape)", "```",
    ]  # fmt: skip
    for name in sorted(polcap.__all__, key=lambda name: (name[0].isupper(), name)):
        source = inspect.getsource(getattr(polcap, name)).removeprefix("@_in_python\n")
        definition = ast.parse(source).body[0]
        if isinstance(definition, ast.FunctionDef):  # its signature and docstring, without the body
            source = "\n".join(source.splitlines()[: definition.body[0].end_lineno])
        lines += ["", f"## polcap.{name}", "", "```python", source.rstrip(), "```"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text, encoding="utf-8")
