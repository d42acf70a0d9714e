"""Searches a picture for a ColorChecker, with OpenCV's detector at several scales and exposures."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics.projection import transform_points
from polcap.stages.whitebalance import chart
from polcap.stages.whitebalance.chart import Placement

_WORK_PITCH_PX = 32.0  # a chart with more pixels per patch is averaged down before it is refined
_NEAR_PITCH_PX, _LAST_STEPS = 10.0, 4  # pitch of the first refinement, right to 0.01 patch; steps of the second
_TILE_PX, _TILE_STEP_PX = 900, 600
_GAMMA = (255 * np.linspace(0, 1, 2**14) ** (1 / 2.2)).astype(np.uint8)
_QUICK_SIDE = 600  # px of the picture that is searched first: ten times as fast
# Detector parameters for it: the defaults scaled by 0.4, with five thresholds instead of nine.
_QUICK = {
    "minImageSize": 400,
    "minContourLengthAllowed": 40,
    "minContoursArea": 16.0,
    "adaptiveThreshWinSizeMin": 9,
    "adaptiveThreshWinSizeMax": 61,
    "adaptiveThreshWinSizeStep": 12,
}
_CANDIDATES = 3  # per picture, because the detector may prefer a texture to the chart


def candidates(value: Floats) -> Iterator[tuple[Floats, float]]:
    """Patch centers (24, 2) px and detector cost of possible charts in a picture (H, W, 3)."""
    small = _resized(value, min(1.0, _QUICK_SIDE / max(value.shape[:2])))
    yield from _detected(_detector(_QUICK), _eight_bits(small, _white(value)), _scaling(small.shape, value.shape))
    detector = _detector({})
    for picture, transform in _pictures(value):
        yield from _detected(detector, picture, transform)


def refine(value: Floats, start: Placement) -> Placement:
    """Refine the location of a chart in a picture (H, W, 3); large charts are averaged down."""
    around = transform_points(start.homography, np.array([[-1.0, -1], [7, -1], [7, 5], [-1, 5]]))
    x0, y0 = np.maximum(np.floor(around.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(around.max(axis=0)).astype(int) + 1, [value.shape[1], value.shape[0]])
    if x1 - x0 < 2 or y1 - y0 < 2:
        return start
    crop, corner = value[y0:y1, x0:x1], np.array([[1.0, 0, -x0], [0, 1, -y0], [0, 0, 1]])
    small = _resized(crop, min(1.0, _WORK_PITCH_PX / start.pitch_px))
    seen = np.clip(small / _white(small), 0.0, 4.0)
    if start.pitch_px < 2 * _NEAR_PITCH_PX:
        return _refined(seen, start, _scaling(seen.shape, crop.shape) @ corner)
    coarse = _resized(seen, _NEAR_PITCH_PX / min(start.pitch_px, _WORK_PITCH_PX))
    near = _refined(coarse, start, _scaling(coarse.shape, crop.shape) @ corner)
    return _refined(seen, near, _scaling(seen.shape, crop.shape) @ corner, _LAST_STEPS)


def _refined(seen: Floats, start: Placement, transform: Floats, steps: int = 12) -> Placement:
    """Refine in a part `seen` of the picture; `transform` (3, 3) maps the picture's px to the part's px."""
    return chart.refine(seen, start.moved(transform), steps).moved(np.linalg.inv(transform))


def _detector(parameters: dict[str, float]) -> Any:
    detector, changed = cv2.mcc.CCheckerDetector.create(), cv2.mcc.DetectorParametersMCC()
    for name, value in parameters.items():
        setattr(changed, name, value)
    detector.setColorChartType(cv2.mcc.MCC24)
    detector.setDetectionParams(changed)
    return detector


def _detected(detector: Any, picture: NDArray[np.uint8], transform: Floats) -> Iterator[tuple[Floats, float]]:
    """Patch centers (24, 2) and costs in one picture; `transform` maps px of the radiance to px of the picture."""
    if detector.process(picture, _CANDIDATES):
        for checker in detector.getListColorChecker():
            quads = np.asarray(checker.getColorCharts(), dtype=np.float64).reshape(24, 4, 2)
            yield transform_points(np.linalg.inv(transform), quads.mean(axis=1)), float(checker.getCost())


def _pictures(value: Floats) -> Iterator[tuple[NDArray[np.uint8], Floats]]:
    """8-bit BGR pictures to search, the most promising first, each with the transform radiance px → picture px.

    First the whole frame at several scales and exposures, with channels balanced or not. Last, for small charts, the
    enlarged frame, or enlarged and overlapping tiles of a large frame, because the detector reduces large pictures.
    """
    height, width = value.shape[:2]
    longest, white = max(height, width), _white(value)
    grey = np.full(3, white.max())
    exposures = {  # (white, gain) by the picture's longer side, px
        1000: [(white, 1.0), (white, 2.5), (white, 0.3), (grey, 1.0), (grey, 2.5), (grey, 0.3)],
        600: [(white, 1.0)],
        1600: [(white, 1.0), (white, 2.5)],
        2400: [(white, 1.0)] if longest <= 2400 else [],
    }
    for side, ways in exposures.items():
        if side > 4.5 * longest:
            continue
        small = _resized(value, side / longest)
        for one, gain in ways:
            yield _eight_bits(small, one / gain), _scaling(small.shape, value.shape)
    if longest > 2400:
        for y in range(0, max(height - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
            for x in range(0, max(width - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
                tile = value[y : y + _TILE_PX, x : x + _TILE_PX]
                large = _resized(tile, 1.5)
                transform = _scaling(large.shape, tile.shape) @ np.array([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]])
                yield _eight_bits(large, _white(tile)), transform


def _white(value: Floats) -> Floats:
    """99th percentile of each channel (3,), from about 10⁵ pixels."""
    step = max(1, int(np.sqrt(value[..., 0].size / 1e5)))
    return np.maximum(np.percentile(value[::step, ::step], 99, axis=(0, 1)), 1e-9)


def _eight_bits(value: Floats, white: Floats) -> NDArray[np.uint8]:
    """Gamma-encoded 8-bit BGR picture, 255 at `white`."""
    level = np.clip(value * np.asarray((len(_GAMMA) - 1) / white, np.float32), 0, len(_GAMMA) - 1)
    return np.ascontiguousarray(_GAMMA[level.astype(np.uint16)][..., ::-1])


def _resized(image: Floats, factor: float) -> Floats:
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return np.asarray(cv2.resize(np.asarray(image, np.float32), size, interpolation=method))


def _scaling(small: tuple[int, ...], large: tuple[int, ...]) -> Floats:
    """Transform (3, 3) from large px to small px, with pixel centers at integers."""
    x, y = small[1] / large[1], small[0] / large[0]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
