"""Gain and read noise are found from the pictures, whatever is in them."""

import numpy as np
import pytest

from polcap.calibration_values import NoiseLine
from polcap.stages.hdr import noise
from tests.stages.hdr.brackets import planes

WELL, READ = 30000.0, 4.0


def picture(rng, exposure=1.0, texture=0.3, size=(512, 640)):
    y, x = np.mgrid[: size[0], : size[1]]
    scene = 0.001 * 500 ** (x / size[1]) * (1 + texture * np.sin(0.9 * x) * np.sin(0.7 * y))
    light = scene[..., None] * WELL * exposure * np.array([0.6, 1.0, 0.8])
    return ((rng.poisson(light) + rng.normal(0, READ, light.shape)) / WELL).astype(np.float32)


def found(samples, iso=100.0):
    line = noise.fit(samples, iso, 1e-12)
    return 1 / line.slope, np.sqrt(line.floor) / line.slope


def test_roughness_keeps_white_noise_and_is_blind_to_ramps():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(1, 400, 400))
    assert noise.second_differences(white).var() == pytest.approx(1, rel=0.03)
    y, x = np.mgrid[:20, :30].astype(float)
    np.testing.assert_allclose(noise.second_differences((3 * x - 2 * y + x * y)[None]), 0, atol=1e-10)


def test_pairs_find_both_gains_under_strong_texture():
    """Texture of 30 % at the pixel scale, two unlike exposures: gain to 5 %, read noise to 1 e⁻."""
    rng = np.random.default_rng(1)
    a, b = picture(rng), picture(rng, 0.25)
    for samples in noise.sample_pair(planes(a), planes(b), np.full(3, 0.25)):
        well, read = found([samples])
        np.testing.assert_allclose(well, WELL, rtol=0.05)
        np.testing.assert_allclose(read, READ, atol=1.5)


def test_single_frame_finds_its_gain_in_flat_tiles():
    rng = np.random.default_rng(2)
    a = picture(rng, texture=0)
    a[:200] *= 1 + 0.3 * np.sin(np.arange(640) * 0.9)[None, :, None]  # two fifths are textured
    well, _ = found([noise.sample_frame(planes(a))])
    np.testing.assert_allclose(well, WELL, rtol=0.1)


def test_unusable_pixels_take_no_part():
    rng = np.random.default_rng(3)
    a = picture(rng, texture=0)
    usable = np.ones(a.shape[:2], bool)
    usable[:, 300:340] = False
    a[:, 300:340] += rng.normal(0, 1, (512, 40, 3)).astype(np.float32)
    well, _ = found([noise.sample_frame(planes(a, usable))])
    np.testing.assert_allclose(well, WELL, rtol=0.1)


@pytest.mark.parametrize("iso", [100.0, 800.0, None])
def test_too_few_tiles_mean_a_typical_sensor(iso):
    line = noise.fit([noise.sample_frame(planes(np.zeros((40, 40, 3))))], iso, 1e-9)
    np.testing.assert_allclose(1 / line.slope, 20000 * 100 / (iso or 100), rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-2, 1e-4])
def test_the_noise_of_radiance_does_not_depend_on_its_scale(scale):
    """Without an ISO, nothing states the sensor's white; without noise, a typical sensor is assumed."""
    noisy, exact = picture(np.random.default_rng(5), texture=0), np.full((200, 200, 3), 0.8, np.float32)
    exact *= np.linspace(0.5, 1, 200, dtype=np.float32)[:, None, None]
    for light in (noisy, exact):
        usual, scaled = (noise.fit([noise.sample_frame(planes(k * light))], None, 1e-20, True) for k in (1.0, scale))
        np.testing.assert_allclose(scaled.slope, scale * usual.slope, rtol=0.02)
        np.testing.assert_allclose(scaled.floor, scale**2 * usual.floor, rtol=0.1)


def test_a_noiseless_picture_keeps_a_variance():
    flat = np.broadcast_to(np.linspace(0.1, 0.9, 400, dtype=np.float32)[:, None, None], (400, 400, 3))
    line = noise.fit([noise.sample_frame(planes(flat))], 100.0, 1e-9)
    assert (line.variance(np.zeros((1, 3))) >= 1e-9).all()


def test_misfit_is_the_mean_square_of_a_small_shift():
    """Shifted by d along the gradient's direction: variance per squared gradient ≈ d²."""
    rng = np.random.default_rng(4)
    x = np.tile(np.arange(500.0), (400, 1))

    def view(shift):
        light = 3000 * (2 + np.sin(0.6 * (x + shift)))[..., None] * np.ones(3)
        return (rng.poisson(light) / WELL).astype(np.float32)

    line = noise.Noise(np.full(3, 1 / WELL), np.full(3, 1e-10))
    shifted = noise.misfit(planes(view(0)), planes(view(0.3)), np.ones(3), (line, line), 1.0)
    # the sine's difference over its central difference: 2 sin²(0.6·0.15) / (sin²(0.6) / 2)
    np.testing.assert_allclose(shifted, 0.101, rtol=0.1)
    assert np.all(noise.misfit(planes(view(0)), planes(view(0)), np.ones(3), (line, line), 1.0) < 1e-3)


def test_lines_are_learnt_once_per_iso():
    rng = np.random.default_rng(5)
    usable = np.ones((512, 640), bool)
    lines = noise.Lines()
    lines.learn(100.0, noise.sample_frame(planes(picture(rng, texture=0), usable)))
    first = lines.line(100.0, 1e-12)
    lines.settle()
    lines.learn(100.0, noise.sample_frame(planes(np.zeros((512, 640, 3)), usable)))
    assert lines.knows(100.0) and not lines.knows(200.0)
    assert lines.line(100.0, 1e-12) is first


def test_calibrated_noise_is_not_learnt_again():
    line = NoiseLine(100.0, (1e-4,), (0.0,), (2e-8,), (0.0,), (1e4,), (1.4,))
    lines = noise.Lines([line])
    rich = noise.Samples(np.full((500, 1), 0.3), np.full((500, 1), 1.0), with_detail=False)
    lines.learn(100.0, rich)
    assert lines.knows(100.0)
    assert lines.line(100.0, 0.0).slope == pytest.approx([1e-4])
    assert not lines.knows(200.0)
