"""In: the settings that the stages declare. Out: docs/reference/settings.md, on stdout.

python docs/make_settings.py > docs/reference/settings.md
"""

from itertools import groupby

from polcap.config import Setting, settings

HEAD = """# Settings

<!-- made by docs/make_settings.py from the stages' own declarations; do not edit -->

Defaults < `--config FILE.toml` (a section per stage) < `--set stage.name=value`.
An unknown name or a value outside its range is an error that names it.
"""


def section(setting: Setting) -> str:
    return setting.key.partition(".")[0]


print(HEAD)
for name, rows in groupby(settings(), section):
    print(f"## {name}\n\n| setting | type | default | range | meaning [unit] |\n| --- | --- | --- | --- | --- |")
    for row in rows:
        kind = row.kind.replace("Optional[float]", "float").removeprefix("Literal").strip("[]")
        default = "unset" if row.default is None else f"`{row.default}`"
        print(f"| `{row.key}` | {kind} | {default} | {row.limits or '–'} | {row.description} |")
    print()
