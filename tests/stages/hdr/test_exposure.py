"""Exposure ratios come out of the pixels without bias."""

import numpy as np
import pytest

from polcap.quality.limits import GateLimits
from polcap.stages.hdr import exposure
from tests.stages.hdr.brackets import planes

WELL = 30000.0


def ratio(reference, other):
    return exposure.of_tiles(*exposure.common_tiles(reference, other))


def picture(rng, factor, low=0.005, high=0.5, size=(320, 400)):
    x = np.geomspace(low, high, size[1])[None, :, None] * np.ones((size[0], 1, 3)) * np.array([0.5, 1, 0.8])
    return (rng.poisson(x * WELL * factor) / WELL).astype(np.float32)


@pytest.mark.parametrize("factor", [0.02, 0.25, 1.0, 1.9])
def test_ratio_within_its_own_sigma_and_a_thousandth(factor):
    rng = np.random.default_rng(0)
    z = []
    for _ in range(6):
        a, b = exposure.common_tiles(planes(picture(rng, 1)), planes(picture(rng, factor)))
        found, sigma = np.transpose([exposure._quotient(a[:, c], b[:, c]) for c in range(3)])
        z.append((found / factor - 1) / sigma)
        assert np.all(np.abs(found / factor - 1) < max(1e-3, 4 * sigma.max()))
    assert np.sqrt(np.mean(np.square(z))) < 1.7  # 18 values


def test_each_channel_has_its_own_ratio():
    """Flash power changes the colour of the light."""
    rng = np.random.default_rng(1)
    tint = np.array([0.48, 0.5, 0.53])
    found = ratio(planes(picture(rng, 1)), planes(picture(rng, tint)))
    np.testing.assert_allclose(found, tint, rtol=1e-3)


def test_moved_things_do_not_count():
    rng = np.random.default_rng(2)
    a, b = picture(rng, 1), picture(rng, 0.5)
    b[40:120, 100:300] *= 1.6  # an eighth of the picture
    np.testing.assert_allclose(ratio(planes(a), planes(b)), 0.5, rtol=1.5e-3)


def test_unusable_pixels_do_not_count():
    rng = np.random.default_rng(3)
    a, b = picture(rng, 1), np.minimum(picture(rng, 4), 0.98)
    np.testing.assert_allclose(ratio(planes(a), planes(b, (b < 0.9).all(axis=2))), 4, rtol=2e-3)


def test_too_few_bright_tiles_give_no_answer():
    rng = np.random.default_rng(4)
    dark = picture(rng, 1, 1e-5, 1e-4)
    assert ratio(planes(dark), planes(dark)) is None
    bright = picture(rng, 1)
    assert ratio(planes(bright), planes(bright, np.zeros((320, 400), bool))) is None


def test_a_frame_without_light_has_next_to_no_exposure():
    """Unless its settings promise little anyway."""
    rng = np.random.default_rng(5)
    tiles = exposure.common_tiles(planes(picture(rng, 1)), planes(np.zeros((320, 400, 3), np.float32)))
    assert exposure.of_tiles(*tiles) is None
    assert exposure.of_unlit(*tiles, 4.0) == pytest.approx(1e-4)
    assert exposure.of_unlit(*tiles, 1e-3) is None and exposure.of_unlit(*tiles, float("nan")) is None
    lit = exposure.common_tiles(planes(picture(rng, 1)), planes(picture(rng, 0.3)))
    assert exposure.of_unlit(*lit, 1.0) is None


def test_vignetting_is_a_smooth_factor_and_none_without_it():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[-1:1:320j, -1:1:400j]
    shade = (1 - 0.15 * (x * x + y * y))[..., None]
    flat, darker = picture(rng, 1.0, low=0.05), picture(rng, 1.0, low=0.05) * shade
    found = exposure.vignetting(planes(flat), planes(darker.astype(np.float32)), np.ones(3, np.float32))
    assert found is not None and np.abs(found - shade[..., 0]).max() < 0.02
    assert exposure.vignetting(planes(flat), planes(picture(rng, 1.0, low=0.05)), np.ones(3, np.float32)) is None


def black_error(*frames):
    """Error of the black level by frames of `picture`, the first of which is the reference."""
    first, *others = map(planes, frames)
    return exposure.black_error([exposure.common_tiles(first, other) for other in others])


@pytest.mark.parametrize("error", [-3e-3, -2e-4, 0.0, 2e-4, [1e-3, 0.0, -1e-3]])
def test_a_wrong_black_level_comes_out_of_the_exposures(error):
    """Light grows with the exposure, black does not; also where the darker half is nearly black."""
    rng = np.random.default_rng(5)
    frames = [picture(rng, factor, low=1e-4) + np.float32(error) for factor in (1, 0.25, 1.9)]
    found, ratio = black_error(*frames)
    np.testing.assert_allclose(found, np.broadcast_to(error, 3), atol=2e-5)
    np.testing.assert_allclose(ratio, [0.25, 1.9], rtol=2e-3)


def test_other_changes_are_no_error_of_the_black_level():
    """Vignetting of a wider aperture, a tone curve, and something that moved."""
    rng = np.random.default_rng(6)
    frames = [picture(rng, factor, low=1e-3) for factor in (1, 0.25, 1.9)]
    y, x = np.mgrid[-1:1:320j, -1:1:400j]
    shaded = [frames[0], frames[1], frames[2] * (1 - 0.2 * (x * x + y * y))[..., None]]
    moved = [frames[0], frames[1], frames[2].copy()]
    moved[2][40:120, 100:300] *= 1.6
    for case in (shaded, [np.maximum(frame, 0) ** 0.45 for frame in frames], moved):
        assert not black_error(*case)[0].any()


def flicker(factor, size=(960, 640)):
    """Flicker of a frame whose light is multiplied by `factor` (H, W)."""
    a, b = (picture(np.random.default_rng(seed), 1, 0.05, 0.4, size) for seed in (9, 10))
    return exposure.flicker(planes(a), planes(b * np.asarray(factor, np.float32)[..., None]))


def test_stripes_of_rows_are_flicker_and_other_changes_are_not():
    y, x = np.mgrid[:960, :640]
    stripes = 1 + 0.01 * np.sin(y / 25)
    assert flicker(stripes) == pytest.approx(0.01 / np.sqrt(2), rel=0.1)
    corners = 1 - 0.1 * ((x / 640 - 0.5) ** 2 + (y / 960 - 0.5) ** 2)  # another aperture
    spot = 1 + 0.05 * np.exp(-((x - 200) ** 2 + (y - 400) ** 2) / 2e4)  # a lamp that is not the flash
    columns = 1 + 0.01 * np.sin(x / 25)
    for other in (np.ones((960, 640)), corners, spot, columns):
        assert flicker(other) < GateLimits().max_flicker
    assert np.isnan(flicker(np.ones((40, 40)), (40, 40)))


def test_noise_of_a_dark_picture_is_no_flicker():
    """Medians of its rows differ by noise: without the error of their power, four of twelve pictures exceed .4 %."""
    found = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        frames = [20 * picture(random, 0.05, 6e-3, 1.2e-2, (180, 240)) for _ in range(2)]  # 20 times fewer electrons
        found.append(exposure.flicker(*map(planes, frames)))
    assert max(found) < GateLimits().max_flicker
