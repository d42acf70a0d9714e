"""Simulated pictures of a checkerboard or color chart in random poses, to calibrate the lens."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.images import Floats, View
from polcap.optics import frames
from polcap.synth import color_checker, lens
from polcap.synth.color_checker import Chart

_SAMPLES = 3  # rays per pixel side
_SQUARES = 9, 6  # inner corners
_WALL = 0.18  # albedo of the wall behind
_MOST_TILT_DEG = 35.0


def pictures(view: View, bend: tuple[float, float], size: tuple[int, int], count: int, kind: str, seed: int
) -> Iterator[Floats]:  # fmt: skip
    """Albedo (H, W, 3) of `count` pictures of a board in front of a gray wall.

    `kind` is "checkerboard", with 9 × 6 inner corners, or "chart"; `bend` is k₁, k₂ of the lens.
    """
    width, height = size
    random = np.random.default_rng([seed, 9])
    for _ in range(count):
        turn = random.uniform(-1, 1, 3) * (_MOST_TILT_DEG, _MOST_TILT_DEG, 15)
        share = random.uniform(-1, 1, 2) * (0.2, 0.16)
        distance = random.uniform(0.85, 1.1)
        center = np.array([share[0] * width / view.focal, share[1] * height / view.focal, -1.0]) * distance
        pitch = 0.6 * width / view.focal / 6 if kind == "chart" else 0.6 * width / view.focal / (_SQUARES[0] + 1)
        total = np.zeros((height, width, 3))
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        y, x = np.mgrid[:height, :width].astype(float)
        for dy in offsets:
            for dx in offsets:
                ray = frames.rays_at(view, *lens.undistort(view, bend, x + dx, y + dy)).reshape(-1, 3)
                total += _albedo(ray, center, turn, pitch, kind).reshape(height, width, 3)
        yield total / _SAMPLES**2


def _albedo(ray: Floats, center: Floats, turn_deg: Floats, pitch: float, kind: str) -> Floats:
    """Albedo (P, 3) at the end of rays (P, 3), which point from the surface to the lens."""
    out = np.full((len(ray), 3), _WALL)
    if kind == "chart":
        x, y, z = (float(v) for v in center)
        a, b, c = (float(v) for v in turn_deg)
        at, _, albedo = color_checker.intersect(Chart(center=(x, y, z), turn_deg=(a, b, c), pitch=pitch), ray)
        out[at] = albedo
        return out
    turn = Rotation.from_rotvec(turn_deg, degrees=True)
    facing, across, down = turn.apply([0.0, 0, 1]), turn.apply([1.0, 0, 0]), turn.apply([0.0, -1, 0])
    point = -ray * (-(center @ facing) / (ray @ facing))[:, None] - center
    column = point @ across / pitch + (_SQUARES[0] + 1) / 2
    row = point @ down / pitch + (_SQUARES[1] + 1) / 2
    inside = (column > -0.5) & (column < _SQUARES[0] + 1.5) & (row > -0.5) & (row < _SQUARES[1] + 1.5)
    out[inside] = 0.85
    on = (column > 0) & (column < _SQUARES[0] + 1) & (row > 0) & (row < _SQUARES[1] + 1)
    dark = on & ((np.floor(column) + np.floor(row)) % 2 == 0)
    out[dark] = 0.04
    return out
