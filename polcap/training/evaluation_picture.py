"""Picture of a few cases of the evaluation, panel.png: photograph and maps, truth above estimate."""

import cv2
import numpy as np

from polcap.images import Bools, Floats, SurfaceMaps
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.training import traced_views
from polcap.training.evaluation_protocol import Case
from polcap.training.map_errors import angle, render_intensity

COLUMNS = (
    "S0", "DoLP 0...0.4, AoLP", "normal", "diffuse", "specular 0...0.3", "roughness", "depth", "relit",
    "error 0...30 deg",
)  # fmt: skip
_TILE, _HEAD = 200, 22  # px
_LIGHT = np.array([-0.6, 0.5, 0.62])


def make_row(case: Case, maps: SurfaceMaps) -> Picture:
    """Picture of one case: truth above, estimate below; in the last column the error above the predicted error."""
    seen, mask, both = case.cues, case.truth.mask, (case.truth, maps)
    s1, s2 = seen.ratio
    depth = [case.depth, case.depth * 0 if maps.depth_prior is None else maps.depth_prior]
    centered = [d - d[mask].mean() for d in depth]
    span = float(np.abs(centered[0][mask]).max())
    relit = [_render(case, one, _LIGHT / np.linalg.norm(_LIGHT)) for one in both]
    white = float(np.percentile(relit[0][mask], 99))
    columns = [
        [pictures.display(seen.radiance, 1.0), pictures.display(_render(case, maps, np.array([0.0, 0.0, 1.0])), 1.0)],
        [pictures.scale(seen.dolp, 0, 0.4, mask), pictures.hue(np.arctan2(s2, s1) / 2, mask)],
        [pictures.normal(one) for one in both],
        [pictures.display(one.diffuse * mask[..., None], 1.0) for one in both],
        [pictures.scale(one.specular.mean(-1), 0, 0.3, mask) for one in both],
        [pictures.scale(one.roughness, 0, 1, mask) for one in both],
        [pictures.scale(-d, -span, span, mask) for d in centered],
        [pictures.display(image, white) for image in relit],
        [pictures.scale(e, 0, 30, mask) for e in (angle(maps, case), maps.confidence)],
    ]
    crop = _box(mask)
    tiles = [np.vstack([_tile(tile[crop]) for tile in column]) for column in columns]
    head = np.full((_HEAD, len(columns) * _TILE, 3), 48, np.uint8)
    _write(head, f"{case.name}: truth above, estimate below", 4)
    return np.vstack([head, np.hstack(tiles)])


def make_sheet(rows: list[Picture]) -> Picture:
    """Picture of all cases, below the names of the columns."""
    head = np.zeros((_HEAD, rows[0].shape[1], 3), np.uint8)
    for k, name in enumerate(COLUMNS):
        _write(head, name, k * _TILE + 4)
    return np.vstack([head, *rows])


def _render(case: Case, maps: SurfaceMaps, light: Floats) -> Floats:
    return traced_views.fill(case.truth.mask, render_intensity(maps, case, case.truth.mask, light))


def _box(mask: Bools) -> tuple[slice, ...]:
    """Square crop around the object, as slices of rows and columns."""
    y, x = np.nonzero(mask)
    side = int(min(max(np.ptp(x), np.ptp(y)) + 5, min(mask.shape)))
    starts = (int(np.clip((a.min() + a.max() - side) // 2, 0, n - side)) for a, n in zip((y, x), mask.shape))
    return tuple(slice(start, start + side) for start in starts)


def _tile(picture: Picture) -> Picture:
    way = cv2.INTER_AREA if picture.shape[0] > _TILE else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (_TILE, _TILE), interpolation=way), np.uint8)


def _write(picture: Picture, text: str, x: int) -> None:
    cv2.putText(picture, text, (x, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
