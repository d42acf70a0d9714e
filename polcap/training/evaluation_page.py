"""Writes the evaluation's result as a page (evaluation.md, with published figures) and a picture (panel.png)."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.stage_values import SurfaceMaps
from polcap.training import traced_views
from polcap.training.evaluation_protocol import Case
from polcap.training.map_errors import render_intensity
from polcap.training.scores import LIMITS_DEG, grid

# Deschaintre, Lin & Ghosh, CVPR 2021, tables 1 and 2, on the authors' own test set
_FIGURES = ("normal_mean", "diffuse", "roughness", "specular", "depth", "rendering")
_PAPER = {"paper": dict(zip(_FIGURES, (12.00, 0.0382, 0.113, 0.0293, 0.174, 0.024)))}
PUBLISHED = _PAPER | {
    "Li 2018": {"normal_mean": 42.23, "depth": 0.339, "rendering": 0.103},
    "Boss 2020": {"normal_mean": 47.69, "depth": 0.327, "rendering": 0.185},
}
PUBLISHED_ABLATIONS = _PAPER | {
    "paper (a), plain skips": dict(zip(_FIGURES, (14.17, 0.05, 0.115, 0.07, 0.176, 0.0285))),
    "paper (b), unpolarized loss": dict(zip(_FIGURES, (12.38, 0.087, 0.131, 0.0339, 0.196, 0.0351))),
    "paper (c), no polarization": dict(zip(_FIGURES, (24.14, 0.0783, 0.155, 0.0555, 0.223, 0.0485))),
}


def _row_names() -> dict[str, str]:
    """Names of the result table's rows, by the key of their figure."""
    names: dict[str, str] = {}
    for end, core in (("", ""), ("_core", ", eroded mask")):
        names |= {f"normal_{kind}{end}": f"normal, {kind}{core} [°]" for kind in ("mean", "median")}
        names |= {f"normal_within_{one:g}{end}": f"normal under {one:g}°{core} [%]" for one in LIMITS_DEG}
    errors = {"": "RMSE", "_l1": "L1", "_picture": "RMSE, whole picture", "_l1_picture": "L1, whole picture"}
    for image in ("diffuse", "roughness", "specular", "rendering"):
        names |= {image + end: f"{image} {name}" for end, name in errors.items()}
        if image == "diffuse":
            names["diffuse_clipped"] = "diffuse RMSE in clipped highlights"
        if image == "specular":
            names["depth"] = "depth RMSE"
            names["depth_fitted"] = "depth RMSE, scale and shift fitted"
            names["depth_integrated"] = "depth RMSE after integration"
    return names


ROWS = _row_names()
_AVERAGED = (
    "RMSE is the root of the mean square over a picture's masked pixels and channels (for renderings over the 20 "
    "lights too); each figure is the mean of all pictures, as the paper's tables suggest. Depth is the estimated map, "
    "centered within the mask and divided by the truth's range, without a fitted scale; after integration: the surface "
    "of stage 9 from the normals and this map, at about 128 px. Renderings are linear and clipped to 0…1, where 1 is "
    "the 99th percentile of the truth under the flash; refractive index 1.5, no cast shadows. The eroded mask is 2 px "
    "thinner. Over the whole picture the error outside the object is zero: RMSE times the root of the object's share "
    "of the picture, L1 times the share. The paper's text mentions L1, its captions RMSE, and neither names the area; "
    "its figures are in the first row of each."
)
Table = Mapping[str, Mapping[str, float]]
COLUMNS = (
    "S0", "DoLP 0...0.4, AoLP", "normal", "diffuse", "specular 0...0.3", "roughness", "depth", "relit",
    "error 0...30 deg",
)  # fmt: skip
_TILE, _HEAD = 200, 22  # px
_LIGHT = np.array([-0.6, 0.5, 0.62])


def make_page(result: Mapping[str, Any]) -> str:
    """Markdown page with the figures of evaluation.json."""
    conditions = result["conditions"]
    ratios = [f"{name} {value:.2f}" for name, value in result["of_mean_maps"].items()]
    parts = [
        f"# Evaluation: {conditions['pictures']} pictures at {conditions['size']}²",
        f"{conditions['subjects']}, protocol {conditions['protocol']} ({conditions['materials']}). "
        f"Model {conditions['model'][:12]} {conditions['version']}. Camera: {conditions['camera']}.",
        f"Standard deviation of the truth's F0 over all pictures: {conditions['f0_deviation']:.3f}.",
        _table(result["table"], PUBLISHED),
        _AVERAGED,
        "*As published*: on the authors' test set, which is not public, so the columns cannot be compared directly.",
        f"RMSE of ours divided by that of the best constant map: {', '.join(ratios)}.",
    ]
    if result["ablations"]:
        parts += [
            "## Networks alone, at one reduced budget",
            "Each sees the picture binned to about the size of training. Its maps are enlarged, without inversion.",
            _table(result["ablations"], PUBLISHED_ABLATIONS),
        ]
    tenths = [
        [str(k + 1), *(f"{n:.2f}" for n in (r["predicted"], r["actual"], r["predicted"] / max(r["actual"], 1e-6)))]
        for k, r in enumerate(result["calibration"])
    ]
    parts += [
        "## Expected normal error, by tenths of the pixels",
        grid(["tenth", "predicted [°]", "actual [°]", "predicted / actual"], tenths),
        "## Cost",
        grid(["", "s per picture"], [[name, f"{value:.2f}"] for name, value in result["seconds"].items()]),
    ]
    return "\n\n".join(parts) + "\n"


def _table(columns: Table, published: Table) -> str:
    columns = {**columns, **{f"{name} *(as published)*": figures for name, figures in published.items()}}
    rows = [key for key in ROWS if any(key in figures for figures in columns.values())]
    return grid(["", *columns], [[ROWS[key], *(_cell(key, c.get(key)) for c in columns.values())] for key in rows])


def _cell(key: str, value: float | None) -> str:
    """A score as text."""
    if value is None:
        return "–"
    if "within" in key:
        return f"{100 * value:.1f}"
    return f"{value:.2f}" if key.startswith("normal") else f"{value:.4f}"


def make_row(case: Case, maps: SurfaceMaps) -> Picture:
    """Picture of one evaluation case: true maps above estimated ones; last the normal error above the predicted."""
    seen, mask, both = case.cues, case.truth.mask, (case.truth, maps)
    s1, s2 = seen.ratio
    depth = [case.depth, case.depth * 0 if maps.depth_prior is None else maps.depth_prior]
    centered = [d - d[mask].mean() for d in depth]
    span = float(np.abs(centered[0][mask]).max())
    relit = [_render(case, one, _LIGHT / np.linalg.norm(_LIGHT)) for one in both]
    white, error = float(np.percentile(relit[0][mask], 99)), frames.angle_deg(maps.normal, case.truth.normal)
    columns = [
        [pictures.display(seen.radiance, 1.0), pictures.display(_render(case, maps, np.array([0.0, 0.0, 1.0])), 1.0)],
        [pictures.scale(seen.dolp, 0, 0.4, mask), pictures.hue(np.arctan2(s2, s1) / 2, mask)],
        [pictures.normal(one) for one in both],
        [pictures.display(one.diffuse * mask[..., None], 1.0) for one in both],
        [pictures.scale(one.specular.mean(-1), 0, 0.3, mask) for one in both],
        [pictures.scale(one.roughness, 0, 1, mask) for one in both],
        [pictures.scale(-d, -span, span, mask) for d in centered],
        [pictures.display(image, white) for image in relit],
        [pictures.scale(e, 0, 30, mask) for e in (error, maps.confidence)],
    ]
    crop = _box(mask)
    tiles = [np.vstack([_tile(tile[crop]) for tile in column]) for column in columns]
    head = np.full((_HEAD, len(columns) * _TILE, 3), 48, np.uint8)
    _write(head, f"{case.name}: truth above, estimate below", 4)
    return np.vstack([head, np.hstack(tiles)])


def make_sheet(rows: list[Picture]) -> Picture:
    """Picture of all evaluation cases in rows, below the names of the map columns."""
    head = np.zeros((_HEAD, rows[0].shape[1], 3), np.uint8)
    for k, name in enumerate(COLUMNS):
        _write(head, name, k * _TILE + 4)
    return np.vstack([head, *rows])


def _render(case: Case, maps: SurfaceMaps, light: Floats) -> Floats:
    return traced_views.fill(case.truth.mask, render_intensity(maps, case, case.truth.mask, light))


def _box(mask: Bools) -> tuple[slice, ...]:
    """Square crop around the object's mask, as slices of rows and columns."""
    y, x = np.nonzero(mask)
    side = int(min(max(np.ptp(x), np.ptp(y)) + 5, min(mask.shape)))
    starts = (int(np.clip((a.min() + a.max() - side) // 2, 0, n - side)) for a, n in zip((y, x), mask.shape))
    return tuple(slice(start, start + side) for start in starts)


def _tile(picture: Picture) -> Picture:
    kind = cv2.INTER_AREA if picture.shape[0] > _TILE else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (_TILE, _TILE), interpolation=kind), np.uint8)


def _write(picture: Picture, text: str, x: int) -> None:
    cv2.putText(picture, text, (x, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
