"""Simulated pictures of a checkerboard or color chart in random poses, to calibrate the lens."""

from collections.abc import Iterator

import numpy as np

from polcap.images import Floats, View
from polcap.optics import frames
from polcap.synth import color_checker, lens
from polcap.synth.color_checker import Chart

_SAMPLES = 3  # rays per pixel side
_COLUMNS, _ROWS = 10, 7  # squares of the checkerboard
_WALL, _PAPER, _INK = 0.18, 0.85, 0.04  # albedos: of the wall behind, of the checkerboard
_MOST_TILT_DEG = 35.0


def pictures(view: View, bend: tuple[float, float], size: tuple[int, int], count: int, kind: str, seed: int
) -> Iterator[Floats]:  # fmt: skip
    """Albedo (H, W, 3) of `count` pictures of a board in front of a gray wall.

    `kind` is "checkerboard", with 9 × 6 inner corners, or "chart"; `bend` is k₁, k₂ of the lens.
    """
    width, height = size
    random = np.random.default_rng([seed, 9])
    across = width / view.focal  # of the picture, at distance 1
    pitch = 0.6 * across / (6 if kind == "chart" else _COLUMNS)
    for _ in range(count):
        turn = random.uniform(-1, 1, 3) * (_MOST_TILT_DEG, _MOST_TILT_DEG, 15)
        share = random.uniform(-1, 1, 2) * (0.2, 0.16)
        x, y, z = np.array([share[0] * across, share[1] * height / view.focal, -1.0]) * random.uniform(0.85, 1.1)
        board = Chart((float(x), float(y), float(z)), tuple(turn.tolist()), pitch)
        total = np.zeros((height, width, 3))
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        y, x = np.mgrid[:height, :width].astype(float)
        for dy in offsets:
            for dx in offsets:
                ray = frames.rays_at(view, *lens.undistort(view, bend, x + dx, y + dy)).reshape(-1, 3)
                total += _albedo(ray, board, kind).reshape(height, width, 3)
        yield total / _SAMPLES**2


def _albedo(ray: Floats, board: Chart, kind: str) -> Floats:
    """Albedo (P, 3) at the end of rays (P, 3), which point from the surface to the lens."""
    out = np.full((len(ray), 3), _WALL)
    if kind == "chart":
        at, _, albedo = color_checker.intersect(board, ray)
        out[at] = albedo
        return out
    _, column, row = color_checker.meet_plane(board, ray)
    column, row = column + _COLUMNS / 2, row + _ROWS / 2
    out[(column > -0.5) & (column < _COLUMNS + 0.5) & (row > -0.5) & (row < _ROWS + 0.5)] = _PAPER
    on = (column > 0) & (column < _COLUMNS) & (row > 0) & (row < _ROWS)
    out[on & ((np.floor(column) + np.floor(row)) % 2 == 0)] = _INK
    return out
