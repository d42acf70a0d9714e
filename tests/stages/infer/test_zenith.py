"""Zeniths of balls that were drawn by a law of diffuse polarization, and of two real balls."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from polcap.image_values import Floats, View
from polcap.optics import body, frames, fresnel
from polcap.stage_values import Cues
from polcap.stages.infer.zenith import estimate_zenith

RADIUS, SIZE = 70, 160
DEGREES = (25, 35, 45, 55, 65, 70)
# DoLP over the smooth law's (n = 1.5) of two real matte balls, 0° and 90° extrapolated
PLACES = [0, 32, 44, 56, 68, 74, 90]
MEASURED = {
    "first": [0.87, 0.82, 0.71, 0.59, 0.50, 0.5, 0.42],
    "second": [0.90, 0.84, 0.73, 0.65, 0.55, 0.5, 0.45],
    "mean": [0.88, 0.83, 0.72, 0.62, 0.525, 0.5, 0.44],
}


def ball(dolp_of: Callable[[Floats], Floats], alpha: float, albedo: Floats | float = 0.4) -> tuple[Cues, Floats]:
    """Cues of a ball under a flash at the lens, and its zeniths (H, W) rad."""
    y, x = np.mgrid[:SIZE, :SIZE]
    middle = (SIZE - 1) / 2
    nx, ny = (x - middle) / RADIUS, (middle - y) / RADIUS
    cosine = np.sqrt(np.maximum(1 - nx**2 - ny**2, 1e-6))
    mask, phi = nx**2 + ny**2 < 1, np.arctan2(ny, nx)
    dolp = np.where(mask, dolp_of(np.arccos(cosine)), 0).astype(np.float32)
    light = np.where(mask, albedo * cosine * body.leaving(cosine, alpha, 1.5)[0] ** 2, 0)
    view = View(1e5, (middle, middle), 1.0)
    axis = np.stack([np.cos(2 * phi), np.sin(2 * phi)]).astype(np.float32)
    found = Cues(
        radiance=np.repeat(light[..., None], 3, -1).astype(np.float32), ratio=dolp * axis,
        ratio_sigma=np.full(mask.shape, 1e-4, np.float32), dolp=dolp, normalized_stokes=axis,
        diffuse_color=np.zeros((*mask.shape, 3), np.float32), rays=frames.rays(view, SIZE, SIZE), mask=mask,
        quality=np.zeros(mask.shape, np.uint8), view=view,
    )  # fmt: skip
    return found, np.arccos(cosine)


def bias_deg(angle: Floats, truth: Floats, mask: NDArray[np.bool_]) -> Floats:
    near = [mask & (np.abs(truth - np.radians(d)) < np.radians(2.5)) for d in DEGREES]
    return np.degrees([np.mean((angle - truth)[ring]) for ring in near])


def bias_by_smooth_law(cues: Cues, truth: Floats) -> Floats:
    return bias_deg(np.arccos(fresnel.cos_zenith_from_dolp(cues.dolp.astype(float), 1.5)), truth, cues.mask)


def chequered() -> Floats:
    y, x = np.mgrid[:SIZE, :SIZE]
    return 0.2 + 0.5 * (np.sin(x / 7) * np.sin(y / 9) > 0)


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("alpha", [0.0, 0.2, 0.4])
def test_a_ball_drawn_by_a_law_gets_its_zeniths_back(alpha: float, textured: bool) -> None:
    albedo = chequered() if textured else 0.4
    cues, truth = ball(lambda zenith: body.dolp(np.cos(zenith), alpha, 1.5), alpha, albedo)
    found = estimate_zenith(cues.dolp, cues, 1.5)
    assert np.abs(bias_deg(found.angle, truth, cues.mask)).max() < 1.6


def test_an_even_depolarization_is_found_too() -> None:
    """An even loss is less certain than one that grows towards the outline; the two laws differ by 2° only."""
    cues, truth = ball(lambda zenith: 0.8 * body.dolp(np.cos(zenith), 0.0, 1.5), 0.0)
    found = bias_deg(estimate_zenith(cues.dolp, cues, 1.5).angle, truth, cues.mask)
    assert np.abs(found).max() < 2.2 and np.abs(found).mean() < 0.5 * np.abs(bias_by_smooth_law(cues, truth)).mean()


@pytest.mark.parametrize("shading", ["even", "chequered", "flat"])
@pytest.mark.parametrize("which", MEASURED)
def test_real_balls_are_read_within_2_degrees(which: str, shading: str) -> None:
    """From 25° to 70°, where the smooth law reads 68° as 53°; how flat a real rough body looks is not known."""

    def measured(zenith: Floats) -> Floats:
        return np.interp(np.degrees(zenith), PLACES, MEASURED[which]) * body.dolp(np.cos(zenith), 0.0, 1.5)

    cues, truth = ball(measured, 0.27, chequered() if shading == "chequered" else 0.4)
    if shading == "flat":
        cosine = np.cos(truth)
        flatter = body.flattening(cosine, cosine, np.ones_like(cosine), 0.15 + 0 * cosine)
        cues = replace(cues, radiance=(cues.radiance * flatter[..., None]).astype(np.float32))
    found = bias_deg(estimate_zenith(cues.dolp, cues, 1.5).angle, truth, cues.mask)
    assert np.abs(found).max() < 2.0 and np.abs(found).mean() < 0.25 * np.abs(bias_by_smooth_law(cues, truth)).mean()


def test_a_guide_settles_what_shading_leaves_open() -> None:
    rng = np.random.default_rng(0)
    speckle = np.exp(rng.normal(size=(SIZE, SIZE)))
    cues, truth = ball(lambda zenith: body.dolp(np.cos(zenith), 0.3, 1.5), 0.3, speckle)
    guide = truth + np.radians(3) * rng.normal(size=truth.shape), np.full(truth.shape, np.radians(5.0))
    found = estimate_zenith(cues.dolp, cues, 1.5, guide)
    assert np.abs(bias_deg(found.angle, truth, cues.mask)).max() < 2.0
    alone = estimate_zenith(cues.dolp, cues, 1.5)
    assert found.spread[cues.mask].mean() <= alone.spread[cues.mask].mean() + 1e-6


def test_too_few_pixels_leave_the_laws_as_likely_as_before() -> None:
    cues, _ = ball(lambda zenith: body.dolp(np.cos(zenith), 0.0, 1.5), 0.0)
    mask = np.zeros_like(cues.mask)
    mask[80, 80:84] = True
    found = estimate_zenith(cues.dolp, replace(cues, mask=mask), 1.5)
    assert np.isfinite(found.angle).all() and found.spread.max() > np.radians(3)
