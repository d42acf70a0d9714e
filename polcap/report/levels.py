"""Table of the levels of detail that the exports of a result have, from its maps.json."""

from pathlib import Path

from polcap.formats.maps import maps_folder
from polcap.formats.maps.maps_folder import LevelNote

HEAD = ("File", "Triangles", "Size", "Distance from the full mesh", "Up to this height on the screen")


def rows(out: Path) -> list[tuple[str, ...]]:
    """Rows of the table with the columns `HEAD`, a row per file; empty without levels of detail."""
    exports = maps_folder.read_exports(out / "maps")
    return [_row(f"{at}/{file}", level) for at, one in exports.items() for file, level in one.lods.items()]


def _row(file: str, level: LevelNote) -> tuple[str, ...]:
    height = "" if level.screen_px is None else f"{level.screen_px} px"
    return file, f"{level.triangles:,}", f"{level.bytes / 1e6:.2f} MB", level.error, height
