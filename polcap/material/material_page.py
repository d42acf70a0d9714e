"""report.json and report.html of a material: verdict, the sample under a light that moves, maps, a table by view."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from polcap.formats import atomic, html
from polcap.image_values import Floats
from polcap.material.height_map import MaterialMaps
from polcap.material.material_maps import MaterialSource
from polcap.material.texel_fit import IOR
from polcap.optics import color, frames, shade
from polcap.optics.resize import area_mean
from polcap.report import keys, labels, map_figures, page
from polcap.report.keys import ColorKey

_LONGEST = 640  # px of a map on the page
_DISTANCE = 4.0  # of the camera on the page, in widths of the sample
_LIGHT = np.array([-0.45, 0.35, 0.82], np.float32)  # first direction; from the front, gloss would be one highlight


def write(folder: Path, about: Mapping[str, Any], source: MaterialSource) -> None:
    """Write report.json and report.html into a result folder. Raises StorageError."""
    atomic.write_json(folder / "report.json", about)
    small, figures = _reduce(source.maps), about["figures"]
    lit = _render(small)
    exposure = 0.9 / max(float(np.quantile(lit, 0.995)), 1e-6)  # all but the brightest 0.5 % stay below 0.9
    height, width = small["roughness"].shape
    content = {
        "lit": html.jpeg(color.srgb_eight_bits(exposure * lit)),
        "maps": _figures(small),
        "rows": [_row(row) for row in figures["views"].values()],
        "left_out": list(figures["left_out"].items()),
        "size": _size(figures["maps"]),
    }
    view = {
        "size": [width, height], "center": [(width - 1) / 2, (height - 1) / 2], "focal": _DISTANCE * width,
        "ior": IOR, "exposure": exposure, "top": keys.F0.high, "light": _LIGHT.tolist(),
    }  # fmt: skip
    page.write_report("material.html", folder, about, content, {"view": view})


def _reduce(maps: MaterialMaps) -> dict[str, Floats]:
    """The maps at most `_LONGEST` texels a side."""
    height, width = maps.seen.shape
    scale = min(1.0, _LONGEST / max(height, width))
    shape = max(1, round(scale * height)), max(1, round(scale * width))
    small = {
        name: area_mean(np.asarray(value, np.float32), shape)
        for name, value in vars(maps).items()
        if isinstance(value, np.ndarray)
    }
    return {**small, "normal": frames.unit(small["normal"])}


def _render(small: Mapping[str, Floats]) -> Floats:
    """S0 (H, W, 3) of the sample seen from above under a lamp at the side, linear Rec.709."""
    light = np.broadcast_to(_LIGHT / np.linalg.norm(_LIGHT), small["normal"].shape)
    seen = shade.stokes(
        small["normal"], small["diffuse"], small["specular"], small["roughness"], np.float32(IOR), light, np.float32(1)
    )
    return np.asarray(seen[0])


def _figures(small: Mapping[str, Floats]) -> list[map_figures.MapFigure]:
    """Pictures of the reduced maps, each with its key."""
    inside = np.ones(small["roughness"].shape, bool)
    micron = 1e6 * small["height"]
    low, high = (float(q) for q in np.quantile(micron, (0.001, 0.999)))
    high = max(high, low + 1e-3)
    span = ColorKey(low, high, " µm", tuple(np.linspace(low, high, 4)), digits=0)
    doubt = ColorKey(0, 5, "°", (0, 1, 2, 3, 5), "inferno", digits=2)
    rough_doubt = ColorKey(0, 0.2, "", (0, 0.05, 0.1, 0.2), "inferno", digits=3)
    return [
        map_figures.normal("normal", "Normal", small["normal"], inside),
        map_figures.albedo("diffuse", "Diffuse albedo", "ρ_d, linear: red, green, blue", small["diffuse"], inside, 1.0),
        map_figures.albedo("specular", "Specular albedo F0", "linear", small["specular"], inside, keys.F0.high),
        map_figures.scalar(
            "roughness", "Roughness", "perceptual: 0 is a mirror, 1 is matt", small["roughness"], inside, keys.ROUGHNESS
        ),
        map_figures.scalar("height", "Height", "above the mean", micron, inside, span),
        map_figures.scalar("doubt", "Doubt of the normal", "1σ", small["normal_sigma"], inside, doubt),
        map_figures.scalar("gloss", "Doubt of the roughness", "1σ", small["roughness_sigma"], inside, rough_doubt),
    ]


def _size(maps: Mapping[str, Any]) -> str:
    """Sentences on size and height of the sample."""
    wide, tall = (labels.number(side, 3) for side in maps["extent_mm"])
    low, high = maps["height_mm"]
    return (
        f"{wide} × {tall} mm, {maps['size'][0]} × {maps['size'][1]} texels of {labels.number(maps['texel_mm'], 3)} mm; "
        f"relief of {labels.number(high - low, 2)} mm, {labels.number(maps['thickness_mm'], 2)} mm above the board."
    )


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    """A view's row of the page's table, from its figures."""
    return (
        row["name"],
        f"{row['tilt_deg']:.0f}°",
        str(row["corners"]),
        f"{labels.number(row['reprojection_px'])} px",
        f"{100 * row['light']:.1f} %",
        f"{labels.number(100 * row['residual'])} %",
    )
