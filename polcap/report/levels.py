"""Table of the levels of detail that the exports of a result have, from its maps.json."""

from pathlib import Path

from polcap.formats.maps import maps_folder

HEAD = ("File", "Triangles", "Size", "Distance from the full mesh", "Up to this height on the screen")


def rows(out: Path) -> list[tuple[str, ...]]:
    """Rows of the table with the columns `HEAD`, a row per file; empty without levels of detail."""
    found: list[tuple[str, ...]] = []
    for folder, one in maps_folder.read_exports(out / "maps").items():
        for file, level in one.lods.items():
            height = "" if level.screen_px is None else f"{level.screen_px} px"
            size = f"{level.bytes / 1e6:.2f} MB"
            found.append((f"{folder}/{file}", f"{level.triangles:,}", size, level.error, height))
    return found
