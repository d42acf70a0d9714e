"""Pictures of a ColorChecker Classic at a known place, through a camera of known colors."""

from typing import Any

import cv2
import numpy as np

from polcap.chart_values import ChartReference, ChartRequest, ColorCalibration
from polcap.formats import shipped_data
from polcap.image_values import Floats, Quality, View
from polcap.optics.projection import transform_points
from polcap.stage_values import AngleStack, ColorSensor, single_frames
from polcap.stages import whitebalance

CLASSIC = shipped_data.colorchecker()
CAMERA = np.array([[0.28, 0.10, 0.07], [0.08, 0.71, 0.22], [0.02, 0.18, 0.66]])  # linear Rec.709 → S0 in camera
WIDTH, HEIGHT = 480, 360
AUTO = ChartRequest("auto")


def pose(pitch: float, turn_deg: float, at: tuple[float, float], tilt: tuple[float, float] = (0, 0)) -> Floats:
    """Homography chart → px of a chart centered `at`, turned and (by its horizon) tilted."""
    c, s = pitch * np.cos(np.radians(turn_deg)), pitch * np.sin(np.radians(turn_deg))
    flat = np.array([[c, -s, 0], [s, c, 0], [tilt[0], tilt[1], 1]]) @ np.array([[1, 0, -3], [0, 1, -2], [0, 0, 1]])
    return np.array([[1, 0, at[0]], [0, 1, at[1]], [0, 0, 1]]) @ flat


def draw(
    homography: Floats, colors: Floats, patch: float = 0.87, card: float = 0.03, samples: int = 4,
    size: tuple[int, int] = (6, 4),
) -> Floats:  # fmt: skip
    """A chart of columns × rows on a softly patterned table (H, W, 3), linear Rec.709: each pixel many points' mean."""
    columns, rows = size
    inverse = np.linalg.inv(homography)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    table = 0.2 + 0.05 * np.sin(x / 17)[..., None] * np.cos(y / 23)[..., None] * np.array([1, 0.8, 0.5])
    edges = transform_points(homography, np.array([[0.0, 0], [columns, 0], [columns, rows], [0, rows]]))
    x0, y0 = np.maximum(np.floor(edges.min(axis=0)).astype(int) - 9, 0)
    x1, y1 = np.maximum(np.ceil(edges.max(axis=0)).astype(int) + 9, 0)
    around = np.s_[y0:y1, x0:x1]  # the chart with the edge of its card
    total = np.zeros_like(table[around])
    for dy in (np.arange(samples) + 0.5) / samples - 0.5:
        for dx in (np.arange(samples) + 0.5) / samples - 0.5:
            at = transform_points(inverse, np.stack([x[around] + dx, y[around] + dy], axis=-1))
            u, v = at[..., 0], at[..., 1]
            on = (u > -0.1) & (u < columns + 0.1) & (v > -0.1) & (v < rows + 0.1)
            column = np.clip(np.floor(u), 0, columns - 1).astype(int)
            row = np.clip(np.floor(v), 0, rows - 1).astype(int)
            inside = on & (abs(u - column - 0.5) < patch / 2) & (abs(v - row - 0.5) < patch / 2)
            picture = np.where(on[..., None], card, table[around])
            total += np.where(inside[..., None], colors[row * columns + column], picture)
    table[around] = total / samples**2
    return table


UNKNOWN = ColorSensor()


def stack(image: Floats, view: View | None = None, clip: float = np.inf, sensor: ColorSensor = UNKNOWN) -> AngleStack:
    """One shot of an image in camera channels."""
    height, width = image.shape[:2]
    clipped = (image >= clip).any(axis=-1)
    return AngleStack(
        value=np.minimum(image, clip)[None].astype(np.float32),
        variance=np.full((1, *image.shape), 1e-8, np.float32),
        quality=np.where(clipped, int(Quality.CLIPPED), 0).astype(np.uint8)[None],
        angle=np.zeros(1),
        view=view or View(1000.0, (width / 2, height / 2), 2.0),
        bracket=single_frames(1),
        sensor=sensor,
    )


def measure(
    image: Floats | AngleStack, request: ChartRequest = AUTO, reference: ChartReference = CLASSIC, **settings: Any
) -> ColorCalibration:
    """The calibration of one shot, or of an image (H, W, 3) as the only shot."""
    shot = image if isinstance(image, AngleStack) else stack(image)
    return whitebalance.measure(shot, reference, request, whitebalance.WhitebalanceSettings(**settings))


def photograph(homography: Floats, colors: Floats = CLASSIC.rec709, seed: int = 0, **drawing: Any) -> Floats:
    """I of one shot: half of S0, through a lens (σ = 0.4 px), with photon noise of 20 000 electrons at white."""
    light = cv2.GaussianBlur(draw(homography, colors, **drawing) @ CAMERA.T / 2, (0, 0), 0.4)
    return light + np.random.default_rng(seed).normal(size=light.shape) * np.sqrt(light / 20_000 + 1e-8)
