"""What the site needs beyond its pages: pages listed by folder, the commands' options, links out of docs/ made names.

Read by mkdocs (`hooks:` in mkdocs.yml).
"""

import re
from pathlib import Path
from typing import Any

from typer.main import get_command

from polcap.cli import app

DOCS = Path(__file__).parent
_OUT = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#]*)(?:#[^)]*)?\)")
_OPTIONS = re.compile(r"<!-- options of (\w+) -->")


def on_config(config: Any) -> Any:
    """Put a folder's pages, in the order of their names, where the navigation names the folder."""
    config.nav = [
        {title: _pages(inside) if (DOCS / inside).is_dir() else inside}
        for entry in config.nav
        for title, inside in entry.items()
    ]
    return config


def _pages(folder: str) -> list[str]:
    return [page.relative_to(DOCS).as_posix() for page in sorted((DOCS / folder).glob("*.md"))]


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The options of a command where its page has `<!-- options of NAME -->`, and links out of docs/ as names.

    The site does not hold the files of the repository outside docs/.
    """
    here = (DOCS / page.file.src_uri).parent

    def shown(match: re.Match[str]) -> str:
        target = (here / match[2]).resolve()
        if target.is_relative_to(DOCS) or not target.exists():
            return match[0]
        return f"{match[1]} (`{target.relative_to(DOCS.parent)}`)"

    return _OUT.sub(shown, _OPTIONS.sub(lambda match: options_table(match[1]), markdown))


def options_table(name: str) -> str:
    """What `polcap NAME --help` says of its arguments and options, as a table."""
    command = get_command(app).commands[name]  # type: ignore[attr-defined]
    context = command.make_context(name, [], resilient_parsing=True)
    rows = [record for one in command.params if (record := one.get_help_record(context))]
    lines = ["| option | |", "| --- | --- |"]
    for option, meaning in rows:  # inside `…` a | parts no columns
        lines.append(f"| `{option}` | {' '.join(meaning.split()).replace('|', '&#124;')} |")
    return "\n".join(lines)
