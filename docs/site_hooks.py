"""Changes that the site needs: pages listed by folder, links out of docs/ replaced by names.

Read by mkdocs (`hooks:` in mkdocs.yml).
"""

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
_OUT = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#]*)(?:#[^)]*)?\)")


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
    """Replace links out of docs/ by names: the site does not hold the repository's other files."""
    here = (DOCS / page.file.src_uri).parent

    def shown(match: re.Match[str]) -> str:
        target = (here / match[2]).resolve()
        if target.is_relative_to(DOCS) or not target.exists():
            return match[0]
        return f"{match[1]} (`{target.relative_to(DOCS.parent)}`)"

    return _OUT.sub(shown, markdown)
