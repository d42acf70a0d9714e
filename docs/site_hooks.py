"""Two things that the site needs beyond its pages: every decision listed, and links out of docs/ made names of files.

Read by mkdocs (`hooks:` in mkdocs.yml).
"""

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
_OUT = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#]*)(?:#[^)]*)?\)")


def on_config(config: Any) -> Any:
    """Put the decision records, in order, where the navigation names their folder."""
    _fill(config.nav)
    return config


def _fill(entries: list[Any]) -> None:
    for entry in entries:
        if isinstance(entry, dict):
            for title, inside in entry.items():
                if inside == "explanations/decisions":
                    entry[title] = [str(p.relative_to(DOCS)) for p in sorted((DOCS / inside).glob("*.md"))]
                elif isinstance(inside, list):
                    _fill(inside)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """A link to a file of the repository outside docs/ becomes the file's name; the site does not hold it."""
    here = (DOCS / page.file.src_uri).parent

    def shown(match: re.Match[str]) -> str:
        target = (here / match[2]).resolve()
        if target.is_relative_to(DOCS) or not target.exists():
            return match[0]
        return f"{match[1]} (`{target.relative_to(DOCS.parent)}`)"

    return _OUT.sub(shown, markdown)
