"""Stokes parameters from polarizer shots, against Malus's law and their own noise."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.image_values import MaskedImage, Quality, SensorImage
from polcap.stage_values import AngleStack, ColorSensor, CrossedShot, Equipment, ObjectMask, single_frames
from polcap.stages import stokes
from tests import scenes

WHOLE = ObjectMask(np.ones((8, 9), bool), (0, 0, 9, 8), "user")


def stack(value, angles_deg=(0, 45, 90), sigma=1e-4) -> AngleStack:
    """Shots (K, H, W, 3) at these angles, with one error for all pixels."""
    value, angles = value.astype(np.float32), np.radians(angles_deg)
    quality = np.zeros(value.shape[:3], np.uint8)
    return AngleStack(value, np.full_like(value, sigma**2), quality, angles, scenes.VIEW, single_frames(len(angles)))


def seen(angles_deg, dolp, aolp_deg, noise=0.0, seed=0) -> AngleStack:
    """Malus's law: I(θ) = ½ S0 (1 + ρ cos 2(θ − φ)), S0 = 1."""
    law = 0.5 * (1 + dolp * np.cos(2 * (np.radians(angles_deg) - np.radians(aolp_deg))))
    value = law[:, None, None, None] * np.ones((1, 8, 9, 3))
    value = value + noise * np.random.default_rng(seed).normal(size=value.shape)
    return stack(value, angles_deg, max(noise, 1e-6))


def solve(radiance: AngleStack, calibration=None, alignment=None, object_=WHOLE):
    calibration = calibration or scenes.equal(radiance.angle)
    alignment = alignment or scenes.still(len(radiance.angle))
    return stokes.solve(radiance, alignment, calibration, object_, stokes.StokesSettings())


def test_light_that_leaks_through_a_poor_polarizer_is_made_up_for():
    """Extinction 20: I = ½ (1 + c ρ cos 2(θ − φ)) with c = 19/21."""
    ratio = np.array([20.0, 100.0, np.inf])
    contrast = np.array([19 / 21, 99 / 101, 1.0])
    ideal, leaky = seen((0, 45, 90), 0.3, 25), seen((0, 45, 90), 0.3, 25)
    mean = np.array(0.5)
    value = mean + (ideal.value - mean) * contrast  # S0 = 1
    leaky = replace(leaky, value=value.astype(np.float32), equipment=Equipment(extinction=ratio))
    found, truth = solve(leaky), solve(ideal)
    assert found.stokes == pytest.approx(truth.stokes, abs=1e-6)
    assert found.covariance[5] == pytest.approx(truth.covariance[5] / contrast**2, rel=1e-5, abs=0)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_colors_of_a_mosaic_are_laid_over_one_another(pattern):
    """A grey parabola as superpixels see it: red and blue a quarter of a pixel off, green in the middle."""
    cfa = np.array(["RGB".index(color) for color in pattern], np.uint8).reshape(2, 2)
    sensor = SensorImage(np.zeros((80, 80), np.uint16), np.zeros((1, 1)), 1.0, cfa)
    y, x = np.mgrid[0:40.0, 0:40.0]
    at = [(x + dx, y + dy) for dx, dy in sensor.site_px]
    shot = np.stack([1 + 0.002 * u * u - 0.01 * v for u, v in at], axis=-1).astype(np.float32)
    assert np.ptp(shot[20, 20]) > 0.02
    radiance = replace(stack(np.repeat(0.5 * shot[None], 3, axis=0)), sensor=ColorSensor(site_px=sensor.site_px))
    object_ = ObjectMask(np.ones((40, 40), bool), (10, 10, 30, 30), "user")
    overturned = np.array([[-1, 0, 39], [0, -1, 39], [0, 0, 1.0]])  # the camera stood upside down, its mosaic too
    for transform, picture in ((np.eye(3), shot), (overturned, shot[::-1, ::-1])):
        alignment = replace(scenes.still(3), transform=np.tile(transform, (3, 1, 1)))
        found = solve(radiance, alignment=alignment, object_=object_)
        assert np.ptp(found.stokes[0], axis=-1).max() < 1e-4
        assert found.stokes[0, ..., 1] == pytest.approx(picture[10:30, 10:30, 1], abs=1e-4)


@pytest.mark.parametrize("angles", [(0, 45, 90), (0, 60, 120), (0, 45, 90, 135), (10, 37, 101, 140, 170)])
def test_malus_law_is_inverted(angles):
    found = solve(seen(angles, dolp=0.3, aolp_deg=25)).stokes[:, 4, 4, 1]
    assert np.allclose(found, [1, 0.3 * np.cos(np.radians(50)), 0.3 * np.sin(np.radians(50))], atol=2e-6)  # float32


def test_light_through_a_horizontal_polarizer_has_positive_s1_and_up_right_light_positive_s2():
    assert solve(seen((0, 45, 90), 1.0, 0)).stokes[1, 0, 0, 0] > 0.99
    assert solve(seen((0, 45, 90), 1.0, 45)).stokes[2, 0, 0, 0] > 0.99


def test_three_angles_follow_the_textbook_sum():
    radiance = seen((0, 45, 90), 0.2, 70, noise=0.01)
    i0, i45, i90 = radiance.value.astype(float)
    found = solve(radiance).stokes
    assert np.allclose(found, [i0 + i90, i0 - i90, 2 * i45 - i0 - i90], atol=1e-5)


@pytest.mark.parametrize("angles", [(0, 45, 90), (0, 45, 90, 135), (0, 60, 120)])
def test_covariance_is_the_scatter_of_repeated_captures(angles):
    sigma = 0.01
    results = [solve(seen(angles, 0.2, 30, sigma, seed)) for seed in range(40)]
    samples = np.stack([r.stokes for r in results])  # (N, 3, H, W, C)
    expected = results[0].covariance[[0, 3, 5]].mean((1, 2, 3))
    actual = samples.var(0, ddof=1).mean((1, 2, 3))
    assert np.allclose(actual / expected, 1, atol=0.05)  # 8640 values: 1.6 % of a variance


@pytest.mark.parametrize(("shift", "least"), [(0.0, 0.97), (0.25, 0.5), (0.5, 0.3)])
def test_residuals_over_the_covariance_have_mean_0_and_variance_1_or_less_between_pixels(shift, least):
    """Resampling averages the noise of neighbors, so between pixels the covariance is an upper bound."""
    moved = [np.array([[1, 0, shift * k], [0, 1, -shift * k], [0, 0, 1.0]]) for k in range(3)]
    alignment = replace(scenes.still(), transform=np.array(moved))
    true, found = (
        solve(scenes.stack(moved, noise=noise, seed=3), None, alignment, scenes.ball_object()) for noise in (0.0, 0.01)
    )
    residual = (found.stokes - true.stokes)[:, found.mask].astype(float)  # (3, N, C)
    full = np.empty((*residual.shape[1:], 3, 3))
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    for (i, j), covariance in zip(pairs, found.covariance[:, found.mask]):
        full[..., i, j] = full[..., j, i] = covariance
    normalized = np.linalg.solve(np.linalg.cholesky(full), np.moveaxis(residual, 0, -1)[..., None])[..., 0]
    assert np.abs(normalized.mean((0, 1))).max() < 0.02
    variance = normalized.var((0, 1))
    assert least < variance.min() and variance.max() < 1.03


def test_gains_divide_each_shot():
    gain = np.array([[1.0] * 3, [1.1] * 3, [0.9] * 3])
    radiance = seen((0, 45, 90), 0.3, 25)
    brighter = replace(radiance, value=radiance.value * gain[:, None, None].astype(np.float32))
    found = solve(brighter, scenes.equal(radiance.angle, gain))
    assert np.allclose(found.stokes, solve(radiance).stokes, atol=1e-6)
    variance = float(radiance.variance[0, 0, 0, 0])  # of every shot, whatever its gain
    assert found.covariance[0] == pytest.approx(variance * (1 + 1 / 0.9**2), rel=1e-5, abs=0)  # S0 = I0 + I90
    assert found.covariance[5] == pytest.approx(variance * (1 + 4 / 1.1**2 + 1 / 0.9**2), rel=1e-5, abs=0)


def test_the_ring_s_turn_is_added_to_the_stated_angles():
    turned = replace(seen((3, 48, 93), 0.3, 25), angle=np.radians([0, 45, 90]))
    corrected = scenes.equal(turned.angle + np.radians(3.0))
    assert solve(turned, corrected).stokes == pytest.approx(solve(seen((0, 45, 90), 0.3, 25)).stokes, abs=2e-6)


def test_a_fourth_angle_leaves_a_residual_where_a_shot_lies():
    radiance = seen((0, 45, 90, 135), 0.3, 25)
    assert solve(radiance).residual.max() < 1e-6
    radiance.value[3] *= 1.05
    assert solve(radiance).residual.min() > 0.002


def test_a_crossed_shot_brings_its_light_and_its_doubt_in_the_unit_of_s0():
    """Without polarization D is the crossed light itself (`optics/crossing.py`), and its 1σ scales as it does."""
    radiance = seen((0, 45, 90), 0.0, 0)
    shot = MaskedImage(np.full((8, 9, 3), 0.2), np.full((8, 9, 3), 4e-6), np.zeros((8, 9), np.uint8))
    radiance = replace(radiance, crossed=CrossedShot(shot, 0.0))
    alignment = replace(scenes.still(3), crossed=np.eye(3))
    calibration = replace(scenes.equal(), crossed=np.array([2.0, 3.0, 4.0]))
    body = solve(radiance, calibration, alignment).body
    assert body.value[4, 4] == pytest.approx([0.4, 0.6, 0.8], abs=1e-5)
    assert np.sqrt(body.variance[4, 4]) == pytest.approx([4e-3, 6e-3, 8e-3], rel=1e-5)


def test_angles_that_leave_s2_open_are_refused():
    with pytest.raises(CaptureError, match="do not determine the Stokes parameters"):
        solve(seen((0, 90, 180), 0.3, 25))


def test_impossible_polarization_and_darkness_are_flagged():
    assert (solve(seen((0, 45, 90), 0.9, 20)).quality & Quality.ILL_POSED).all()
    assert not (solve(seen((0, 45, 90), 0.3, 20)).quality & Quality.ILL_POSED).any()
    noisy = seen((0, 45, 90), 0.1, 20, noise=0.4)
    assert (solve(noisy).quality & Quality.DARK).mean() > 0.9


@pytest.mark.parametrize(("right_px", "spoiled"), [(0.0, [4]), (0.2, [3, 4])])
def test_a_pixel_clipped_in_one_angle_spoils_all_that_are_interpolated_from_it(right_px, spoiled):
    radiance = seen((0, 45, 90), 0.3, 20)
    radiance.quality[2, 3, 4] = Quality.CLIPPED
    transform = np.tile(np.eye(3), (3, 1, 1))
    transform[2, 0, 2] = right_px
    clipped = solve(radiance, alignment=replace(scenes.still(), transform=transform)).quality & Quality.CLIPPED
    assert np.flatnonzero(clipped[3]).tolist() == spoiled and not clipped[2].any()


def test_colors_polarized_across_each_other_are_called_metal():
    radiance = seen((0, 45, 90), 0.3, 20, noise=1e-4)
    assert not (solve(radiance).quality & Quality.METAL).any()
    radiance.value[..., 2] = seen((0, 45, 90), 0.3, 60).value[..., 2]
    assert (solve(radiance).quality & Quality.METAL).all()
