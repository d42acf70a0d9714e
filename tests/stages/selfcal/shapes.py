"""Shots of smooth surfaces z(x, y), for the laws of their slopes; self-calibration of the scene of `tests.scenes`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.image_values import Bools, Floats
from polcap.optics import body, mueller
from polcap.stage_values import AngleStack, ObjectMask, SelfCalibration
from polcap.stages import selfcal
from tests import scenes

ANGLES = np.radians([0.0, 45.0, 90.0])
SIZE = 120
Height = Callable[[Floats, Floats], Floats]
SHAPES: dict[str, Height] = {  # x, y in −1…1, y up; only the first has a place that faces the camera
    "ball, seen from the front": lambda x, y: np.sqrt(np.maximum(2.0 - x**2 - y**2, 0.1)),
    "leaning ridge": lambda x, y: 0.35 * x + 0.25 * np.cos(2.2 * y),
    "saddle": lambda x, y: 0.35 * x**2 - 0.15 * y**2 + 0.3 * x,
    "waves on a slope": lambda x, y: 0.3 * y + 0.08 * np.sin(4 * x) * np.cos(3 * y),
}


def shots(height: Height, random: np.random.Generator, angle: Floats = ANGLES, gain: Floats | float = 1.0) -> Floats:
    """Shots (K, H, W) of a smooth body under an even light, with a checkered albedo."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(1, -1, SIZE))
    step = 1e-4
    slope_x, slope_y = (
        (height(x + dx, y + dy) - height(x - dx, y - dy)) / (2 * step) for dx, dy in ((step, 0.0), (0.0, step))
    )
    cosine = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    dolp = body.dolp(cosine, 0.0, 1.5)
    azimuth = np.arctan2(slope_y, slope_x)
    s0 = (0.4 + 0.4 * (np.sin(9 * x) * np.sin(7 * y) > 0)) * cosine
    stokes = np.stack([s0, s0 * dolp * np.cos(2 * azimuth), s0 * dolp * np.sin(2 * azimuth)])
    light = np.einsum("kj,jhw->khw", mueller.analyzer(angle), stokes) * (np.ones(len(angle)) * gain)[:, None, None]
    return np.asarray(light * (1 + 5e-4 * random.normal(size=light.shape)))


def inside(light: Floats) -> Bools:
    """All pixels but four at the edge, (H, W)."""
    used = np.zeros(light.shape[1:], bool)
    used[4:-4, 4:-4] = True
    return used


def misstated(actual: Floats, stated: Floats, noise: float = 0.002) -> AngleStack:
    """Shots of the scene at angles (K,) rad that differ from the stated ones."""
    return replace(scenes.stack(noise=noise, angles=actual), angle=stated)


def solve(
    radiance: AngleStack, color: ColorCalibration | None = None, object_: ObjectMask | None = None, **settings: Any
) -> SelfCalibration:
    """Self-calibration of shots of the scene."""
    still, ball = scenes.still(len(radiance.angle)), object_ or scenes.ball_object()
    return selfcal.solve(radiance, still, ball, color or scenes.no_color(), selfcal.SelfcalSettings(**settings))
