"""Searches a picture for a ColorChecker, with OpenCV's detector at several scales and exposures."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats
from polcap.optics.projection import transform_points
from polcap.stages.whitebalance.chart import resize, scaling, white

_TILE_PX, _TILE_STEP_PX = 900, 600  # side of a tile, and distance of two
_CANDIDATES = 3  # per picture, because the detector may prefer a texture to the chart


def candidates(value: Floats, of_sg: bool = False) -> Iterator[tuple[Floats, float]]:
    """Possible charts in a picture (H, W, 3): patch centers (24, 2) px and detector cost of each.

    With `of_sg` they may be any 6 × 4 patches of a ColorChecker SG: OpenCV finds the whole chart, or takes a part of it
    for a Classic.
    """
    detector: Any = cv2.mcc.CCheckerDetector.create()
    kinds = (cv2.mcc.SG140, cv2.mcc.MCC24) if of_sg else (cv2.mcc.MCC24,)
    for picture, transform, kind in ((*seen, kind) for seen in _pictures(value) for kind in kinds):
        detector.setColorChartType(kind)
        if detector.process(picture, _CANDIDATES):
            for checker in detector.getListColorChecker():
                quads = np.asarray(checker.getColorCharts(), dtype=np.float64).reshape(-1, 4, 2)
                centers = transform_points(np.linalg.inv(transform), quads.mean(axis=1))
                if kind == cv2.mcc.SG140:
                    centers = centers.reshape(10, 14, 2)[1:5, 4:10].reshape(24, 2)  # its block E2 to J5
                yield centers, float(checker.getCost())


def _pictures(value: Floats) -> Iterator[tuple[NDArray[np.uint8], Floats]]:
    """Pictures (8-bit BGR) to search for a chart, best first, each with the transform radiance px → picture px.

    First the whole frame at several scales and exposures, with channels balanced or not. Last, for small charts, the
    enlarged frame, or enlarged and overlapping tiles of a large frame, because the detector reduces large pictures.
    """
    height, width = value.shape[:2]
    longest, balanced = max(height, width), white(value)
    grey = np.full(3, balanced.max())
    exposures = {  # (white, gain) of the pictures, by their longer side, px
        1000: [(balanced, 1.0), (balanced, 2.5), (balanced, 0.3), (grey, 1.0), (grey, 2.5), (grey, 0.3)],
        600: [(balanced, 1.0)],
        1600: [(balanced, 1.0), (balanced, 2.5)],
        2400: [(balanced, 1.0)] if longest <= 2400 else [],
    }
    for side, levels in exposures.items():
        if side > 4.5 * longest:  # enlarged too much
            continue
        small = resize(value, side / longest)
        for level, gain in levels:
            yield _eight_bits(small, level / gain), scaling(small.shape, value.shape)
    if longest > 2400:
        for y in range(0, max(height - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
            for x in range(0, max(width - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
                tile = value[y : y + _TILE_PX, x : x + _TILE_PX]
                large = resize(tile, 1.5)
                transform = scaling(large.shape, tile.shape) @ np.array([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]])
                yield _eight_bits(large, white(tile)), transform


def _eight_bits(value: Floats, level: Floats) -> NDArray[np.uint8]:
    """Encode radiance as a gamma-encoded 8-bit BGR picture, 255 at `level`."""
    encoded = 255 * np.clip(value / level, 0, 1) ** (1 / 2.2)
    return np.ascontiguousarray(encoded[..., ::-1].astype(np.uint8))
