"""report.json and report.html of a fused object: verdict, pictures from eight sides, a table by view."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polcap.formats import atomic, html
from polcap.fusion import object_pictures
from polcap.fusion.fusion_path import FusionResults
from polcap.report import labels, levels, page

_SIDES = 8
_SIDE = 360  # px of a picture


def write(folder: Path, about: Mapping[str, Any], results: FusionResults) -> None:
    """Write report.json and report.html into a result folder; StorageError."""
    atomic.write_json(folder / "report.json", about)
    drawn = object_pictures.around(results.atlas, results.maps, _SIDES, _SIDE)
    content = {
        "sides": [(f"{k * 360 // _SIDES}°", html.jpeg(picture)) for k, picture in enumerate(drawn)],
        "atlas": [(one.caption, one.note, html.jpeg(one.picture)) for one in object_pictures.of_atlas(results.maps)],
        "rows": [_row(row) for row in about["figures"]["views"].values()],
        "left_out": list(about["figures"]["left_out"].items()),
        "size": _size(about["figures"]["mesh"]),
        "levels": (levels.HEAD, levels.rows(folder)),
    }
    page.write_report("fused.html", folder, about, content, {})


def _size(mesh: Mapping[str, Any]) -> str:
    """Sentences on the object's size and its unit."""
    unit, factor = ("mm", 1000.0) if mesh["metric"] else ("in a relative unit", 1.0)
    sides = " × ".join(labels.number(factor * side, 3) for side in mesh["extent"])
    scale = "in metres" if mesh["metric"] else "relative, because the scale is unknown"
    return f"Width, height, depth: {sides} {unit}. Lengths in the files are {scale}."


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    """The figures of one view as texts."""
    return (
        row["name"],
        str(row["corners"]),
        f"{labels.number(row['reprojection_px'])} px",
        f"{labels.number(row['pose_sigma_deg'])}°",
        f"{labels.number(row['normal_deg'])}°",
        "–" if row["residual"] is None else f"{labels.number(100 * row['residual'])} %",
        row["verdict"],
    )
