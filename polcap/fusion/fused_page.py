"""report.json and report.html of a fused object: verdict, pictures from eight sides, a table by view."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from polcap.formats import atomic, html
from polcap.fusion import object_pictures
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.fusion_path import FusionResults
from polcap.fusion.values import IOR
from polcap.optics import frames
from polcap.optics.resize import area_mean, weighted_area_mean
from polcap.report import keys, labels, levels, map_figures, page
from polcap.report.map_figures import MapFigure

_SIDES = 8  # from which the object is drawn
_PICTURE_PX = 360
_LONGEST = 1024  # px, side of a map
_WHITE_QUANTILE = 0.995  # of the albedo; under the lamp it becomes nearly white


def write(folder: Path, about: Mapping[str, Any], results: FusionResults) -> None:
    """Write report.json and report.html into a result folder. Raises StorageError."""
    atomic.write_json(folder / "report.json", about)
    drawn = object_pictures.draw_around(results.atlas, results.maps, _SIDES, _PICTURE_PX)
    figures, view = _atlas_figures(results.maps)
    content = {
        "sides": [(f"{k * 360 // _SIDES}°", html.jpeg(picture)) for k, picture in enumerate(drawn)],
        "seen": html.jpeg(object_pictures.seen_picture(results.maps)),
        "maps": figures,
        "rows": [_row(row) for row in about["figures"]["views"].values()],
        "left_out": list(about["figures"]["left_out"].items()),
        "size": _size(about["figures"]["mesh"]),
        "levels": (levels.HEAD, levels.rows(folder)),
        "turning": "asset/turntable.webp",
    }
    data = {"view": view, "mesh": {**page.mesh_data(results.atlas.mesh), "closed": True}}
    page.write_report("fused.html", folder, about, content, data)


def _atlas_figures(maps: AtlasMaps) -> tuple[list[MapFigure], dict[str, Any]]:
    """Figures of the atlas's maps, and the data of the view of the object that they cover."""
    side = min(_LONGEST, len(maps.mask))
    parts = ("normal", "diffuse", "specular", "roughness")
    small = {name: weighted_area_mean(getattr(maps, name), maps.mask, (side, side)) for name in parts}
    inside = area_mean(maps.mask, (side, side)) > 0.5
    bright = float(np.quantile(small["diffuse"][inside], _WHITE_QUANTILE)) if inside.any() else 1.0
    figures = [
        map_figures.normal("normal", "Normal", frames.unit(small["normal"]), inside),
        map_figures.albedo("diffuse", "Diffuse albedo", "ρ_d, linear: red, green, blue", small["diffuse"], inside, 1.0),
        map_figures.albedo("specular", "Specular albedo F0", "linear", small["specular"], inside, keys.F0.high),
        map_figures.scalar(
            "roughness", "Roughness", "perceptual: 0 is a mirror", small["roughness"], inside, keys.ROUGHNESS
        ),
    ]
    return figures, {
        "size": [side, side],
        "center": [side / 2, side / 2],
        "focal": float(side),
        "ior": IOR,
        "exposure": 0.9 / max(bright, 1e-3),
        "top": keys.F0.high,
    }


def _size(mesh: Mapping[str, Any]) -> str:
    """Sentences on the object's size and its unit."""
    unit, factor = ("mm", 1000.0) if mesh["metric"] else ("in a relative unit", 1.0)
    sides = " × ".join(labels.number(factor * side, 3) for side in mesh["extent"])
    scale = "in metres" if mesh["metric"] else "relative, because the scale is unknown"
    return f"Width, height, depth: {sides} {unit}. Lengths in the files are {scale}."


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    """A view's row of the page's table, from its figures."""
    return (
        row["name"],
        str(row["corners"]),
        f"{labels.number(row['reprojection_px'])} px",
        f"{labels.number(row['pose_sigma_deg'])}°",
        f"{labels.number(row['normal_deg'])}°",
        "–" if row["residual"] is None else f"{labels.number(100 * row['residual'])} %",
        row["verdict"],
    )
