"""`polcap board`: the board to print and lay under an object that is shot from all sides."""

import os
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.cli.options import Json


def board(
    folder: Annotated[Path, Argument(help="Folder to write into.")] = Path(),
    size: Annotated[
        Literal["A4", "A3", "A2"], Option(case_sensitive=False, help="Paper; the object stands on 96, 136 or 192 mm.")
    ] = "A4",
    json: Json = False,
) -> None:
    """Write the board for captures from all sides, as SVG and PDF at true scale."""
    from polcap.errors import SettingError
    from polcap.formats import atomic, board_print
    from polcap.optics.board import BOARDS

    chosen = BOARDS[size]
    files = {".svg": board_print.svg(chosen).encode(), ".pdf": board_print.pdf(chosen)}
    written = [folder / f"board-{size}{suffix}" for suffix in files]
    for file, content in zip(written, files.values(), strict=True):
        if os.path.lexists(file) and not (file.is_file() and file.read_bytes() == content):
            raise SettingError(f"{file} exists and is another file; move it away, or name another folder")
    for file, content in zip(written, files.values(), strict=True):
        atomic.write(file, content)
    terminal.print_written(written, json)
