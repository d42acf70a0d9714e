"""A textured ball beside a flat board, known everywhere, to try the stages on: evaluated, never resampled."""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from polcap.capture_values import ShotOrder
from polcap.chart_values import ColorCalibration
from polcap.image_values import Floats, View
from polcap.optics import frames, mueller, shade
from polcap.optics.warp import warp
from polcap.quality.gate_values import Evidence
from polcap.results import FIELDS, collect
from polcap.stage_values import (
    Alignment,
    AngleStack,
    Cues,
    Gains,
    ObjectMask,
    OutlineCheck,
    RingZero,
    SelfCalibration,
    single_frames,
)
from polcap.stages import cues
from polcap.stages import stokes as stokes_stage

HEIGHT, WIDTH, FOCAL = 240, 320, 900.0
CENTER, RADIUS = (120.0, 118.0), 84.0  # px; x, y of the ball's outline
VIEW = View(focal=FOCAL, center=((WIDTH - 1) / 2, (HEIGHT - 1) / 2), scale=2.0)
ANGLES = np.radians([0.0, 45.0, 90.0])


def normals(x: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Ball normals in the frame of each ray (H, W, 3) and its mask (H, W) at pixel coordinates."""
    u, v = (x - CENTER[0]) / RADIUS, -(y - CENTER[1]) / RADIUS
    inside = u * u + v * v < 0.995
    z = np.sqrt(np.maximum(1 - u * u - v * v, 0.005))
    n = np.stack([u, v, z], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True), inside


def texture(x: Floats, y: Floats) -> Floats:
    """Albedo (H, W, 3) with detail of a few pixels, smooth enough for the sampling."""
    waves = np.sin(0.42 * x + 0.13 * y) + np.sin(0.11 * x - 0.37 * y + 1) + np.sin(0.21 * x + 0.23 * y + 2)
    grey = 0.4 + 0.09 * waves
    return np.stack([grey * 1.1, grey, grey * 0.8], axis=-1)


def stokes(x: Floats, y: Floats, textured: bool = True) -> tuple[Floats, NDArray[np.bool_]]:
    """Noise-free Stokes parameters (3, H, W, 3) in the ray frames, and the ball's mask."""
    n, inside = normals(x, y)
    albedo = texture(x, y) if textured else np.full((*x.shape, 3), 0.5)
    light = np.zeros_like(n)
    light[..., 2] = 1
    ones = np.ones(x.shape)
    ball = shade.stokes(n, albedo, 0.04 * np.ones_like(albedo), 0.5 * ones, 1.5 * ones, light, ones)
    board = (x > 224) & (x < 300) & (y > 30) & (y < 200)
    backdrop = np.where(board, texture(2 * x, 2 * y)[..., 1], 0.004)[..., None] * np.ones(3)
    flat = np.stack([backdrop, 0 * backdrop, 0 * backdrop])
    return np.where(inside[..., None], ball, flat), inside


@functools.lru_cache(maxsize=8)
def pixel_means(to_reference: tuple[float, ...], textured: bool) -> Floats:
    """Stokes parameters (3, H, W, 3) of a shot's pixels, each the mean of 3 × 3 samples: a sensor's own low pass."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    back = np.reshape(to_reference, (3, 3))
    total: Floats = np.zeros((3, HEIGHT, WIDTH, 3))
    for dy, dx in itertools.product((-1 / 3, 0, 1 / 3), repeat=2):
        u, v, w = np.einsum("ij,jhw->ihw", back, np.stack([x + dx, y + dy, np.ones_like(x)]))
        total += stokes(u / w, v / w, textured)[0] / 9
    return total


def stack(
    transforms: Sequence[Floats] | None = None,
    gain: Floats | None = None,
    noise: float = 0.0,
    angles: Floats = ANGLES,
    textured: bool = True,
    seed: int = 0,
    scale: float = 0.5,
) -> AngleStack:
    """The shots of the scene, each evaluated where its own camera pose puts its pixels.

    transforms: reference px → shot px. noise: 1σ at radiance 1, growing with √radiance.
    """
    rng = np.random.default_rng(seed)
    rays = frames.rays(VIEW, HEIGHT, WIDTH)
    values = []
    for k, angle in enumerate(angles):
        back = np.linalg.inv(transforms[k]) if transforms else np.eye(3)
        turned = mueller.analyzer(frames.axis_on_ray(float(angle), rays))  # (H, W, 3)
        light = np.einsum("hwj,jhwc->hwc", turned, pixel_means(tuple(back.ravel().tolist()), textured))
        values.append(light * scale * (1.0 if gain is None else gain[k]))
    value = np.stack(values)
    variance = noise**2 * np.maximum(value, 1e-3) + 1e-12
    value = value + rng.normal(size=value.shape) * np.sqrt(variance) * (noise > 0)
    return AngleStack(
        value=value.astype(np.float32), variance=variance.astype(np.float32),
        quality=np.zeros(value.shape[:3], np.uint8), angle=np.asarray(angles), view=VIEW,
        bracket=single_frames(len(angles)),
    )  # fmt: skip


def before_backdrop(transforms: Sequence[Floats]) -> AngleStack:
    """The ball moved from shot to shot, before a textured backdrop that stays."""
    radiance = stack(transforms, noise=0.002)
    waves = gaussian_filter(np.random.default_rng(5).normal(size=(HEIGHT, WIDTH)), 2.0)
    value = np.repeat((0.1 * np.exp(4 * waves))[None, ..., None], 3, 3).repeat(len(transforms), 0)
    for k, moved in enumerate(transforms):
        inside = warp(ball_object().mask.astype(np.float32), np.linalg.inv(moved), order=1) > 0.5
        value[k][inside] = radiance.value[k][inside]
    return replace(radiance, value=value.astype(np.float32))


def no_color(scale: float = 0.5) -> ColorCalibration:
    """The colour calibration of these shots, which are Rec.709 at `scale`; as from another capture's chart."""
    return ColorCalibration(np.eye(3) / scale, "profile")


def still(shots: int = 3) -> Alignment:
    return Alignment(np.tile(np.eye(3), (shots, 1, 1)), np.zeros(shots), np.ones(shots))


def equal(angle: Floats = ANGLES, gain: Floats | float = 1.0) -> SelfCalibration:
    """Shots at these angles (K,) rad, with these gains (K, 3)."""
    ones = np.ones((len(angle), 3))
    gains = Gains(gain * ones, 0 * ones, ones, "none", 0.0)
    order = ShotOrder(tuple(range(len(angle))))
    return SelfCalibration(gains, np.asarray(angle), OutlineCheck(order, 1.0), RingZero(0.0, 0.0))


def ball_object() -> ObjectMask:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    inside = normals(x, y)[1]
    return ObjectMask(inside, (30, 28, 212, 210), "user")


@functools.lru_cache(maxsize=8)
def seen(noise: float = 0.0, textured: bool = True) -> Cues:
    """Cues of the ball, whose shots do not move."""
    radiance, settings = stack(noise=noise, textured=textured), stokes_stage.StokesSettings()
    return cues.compute(stokes_stage.solve(radiance, still(), equal(), ball_object(), settings), no_color())


def truth() -> tuple[Floats, NDArray[np.bool_]]:
    """Ray-frame normals and mask on the crop of `ball_object`."""
    x0, y0, x1, y1 = ball_object().crop
    y, x = np.mgrid[y0:y1, x0:x1].astype(float)
    return normals(x, y)


def evidence(**parts: Any) -> Evidence[Any]:
    """Evidence of the results of the first stages and of measurements, by their names."""
    results = {stage: parts.pop(name) for stage, name in FIELDS.items() if name in parts}
    return Evidence(collect(results, {}), **parts)
