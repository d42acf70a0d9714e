"""Picture of a few cases of the evaluation, panel.png: photograph and maps, truth above estimate."""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, SurfaceMaps
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.training import traced_views
from polcap.training.evaluation_protocol import Case
from polcap.training.map_errors import angle, render_intensity

COLUMNS = (
    "S0",
    "DoLP 0...0.4, AoLP",
    "normal",
    "diffuse",
    "specular 0...0.3",
    "roughness",
    "depth",
    "relit",
    "error 0...30 deg",
)
_TILE, _HEAD = 200, 22  # px
_LIGHT = np.array([-0.6, 0.5, 0.62])


def make_row(case: Case, maps: SurfaceMaps) -> Picture:
    """Row of a case: truth above, estimate below; in the last column the error above the predicted error."""
    seen, mask = case.cues, case.truth.mask
    s1, s2 = seen.ratio
    depth = [case.depth, case.depth * 0 if maps.depth_prior is None else maps.depth_prior]
    centered = [d - d[mask].mean() for d in depth]
    span = float(np.abs(centered[0][mask]).max())
    columns = [
        [pictures.display(seen.radiance, 1.0), pictures.display(_lit(case, maps, np.array([0.0, 0.0, 1.0])), 1.0)],
        [pictures.scale(seen.dolp, 0, 0.4, mask), pictures.hue(np.arctan2(s2, s1) / 2, mask)],
        *(
            [draw(one) for one in (case.truth, maps)]
            for draw in (
                pictures.normal,
                lambda one: pictures.display(one.diffuse * mask[..., None], 1.0),
                lambda one: pictures.scale(one.specular.mean(-1), 0, 0.3, mask),
                lambda one: pictures.scale(one.roughness, 0, 1, mask),
            )
        ),
        [pictures.scale(-d, -span, span, mask) for d in centered],
        _relit(case, maps),
        [pictures.scale(e, 0, 30, mask) for e in (angle(maps, case), maps.confidence)],
    ]
    crop = _box(mask)
    tiles = [np.vstack([_tile(tile[crop]) for tile in column]) for column in columns]
    return _titled(np.hstack(tiles), case.name)


def _relit(case: Case, maps: SurfaceMaps) -> list[Picture]:
    """Renderings of truth and estimate under a light from the upper left."""
    images = [_lit(case, one, _LIGHT / np.linalg.norm(_LIGHT)) for one in (case.truth, maps)]
    white = float(np.percentile(images[0][case.truth.mask], 99))
    return [pictures.display(image, white) for image in images]


def _lit(case: Case, maps: SurfaceMaps, light: Floats) -> Floats:
    return traced_views.fill(case.truth.mask, render_intensity(maps, case, case.truth.mask, light))


def make_sheet(rows: list[Picture]) -> Picture:
    """All rows, below the names of the columns."""
    head = np.zeros((_HEAD, rows[0].shape[1], 3), np.uint8)
    for k, name in enumerate(COLUMNS):
        _write(head, name, (k * _TILE + 4, 15))
    return np.vstack([head, *rows])


def _box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Square crop around the object."""
    y, x = np.nonzero(mask)
    side = min(max(np.ptp(x), np.ptp(y)) + 5, min(mask.shape))
    starts = (int(np.clip((a.min() + a.max() - side) // 2, 0, n - side)) for a, n in zip((y, x), mask.shape))
    first, second = (slice(start, start + int(side)) for start in starts)
    return first, second


def _tile(picture: Picture) -> Picture:
    way = cv2.INTER_AREA if picture.shape[0] > _TILE else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (_TILE, _TILE), interpolation=way), np.uint8)


def _titled(picture: Picture, name: str) -> Picture:
    head = np.full((_HEAD, picture.shape[1], 3), 48, np.uint8)
    _write(head, f"{name}: truth above, estimate below", (4, 15))
    return np.vstack([head, picture])


def _write(picture: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
