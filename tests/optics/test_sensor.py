"""Counts become signals phase by phase, and saturation is judged on raw counts."""

import numpy as np
import pytest

from polcap.image_values import SensorImage
from polcap.optics import sensor

GRBG = np.array([[1, 0], [2, 1]], np.uint8)


def mosaic(value, black=((100, 101), (102, 103)), white=1100.0):
    return SensorImage(np.asarray(value, np.uint16), np.array(black, float), white, GRBG)


@pytest.mark.parametrize("full", [False, True])
def test_black_is_subtracted_per_phase(full):
    dark = np.tile([[100, 101], [102, 103]], (8, 8))
    np.testing.assert_allclose(sensor.signal(mosaic(dark), full), 0, atol=1e-7)


def test_white_is_one_and_negative_noise_is_kept():
    image = mosaic(np.tile([[1100, 90], [1100, 1100]], (4, 4)), black=[[100]])
    np.testing.assert_allclose(sensor.signal(image)[0, 0], [-0.01, 1, 1], rtol=1e-6)


def test_one_clipped_photosite_rules_out_its_quad_and_the_eight_around():
    value = np.full((20, 20), 500)
    value[10, 9] = 1090
    image = mosaic(value)
    good = sensor.usable(image, 0.98)
    assert not good[4:7, 3:6].any() and good.sum() == 100 - 9
    full = sensor.below(image, sensor.clip_count(image, 0.98), full=True)
    assert full.shape == (20, 20) and full.sum() == 400 - 36
    assert sensor.usable(image, 1.0).all()


def test_three_equal_channels_are_one_monochrome_channel():
    gray = np.random.default_rng(0).integers(0, 1000, (6, 8)).astype(np.uint16)
    image = SensorImage(np.repeat(gray[..., None], 3, 2), np.zeros((1, 1)), 1000.0, None)
    assert sensor.monochrome(image) and sensor.signal(image).shape == (6, 8, 1)
    colored = SensorImage(np.stack([gray, gray, gray + np.uint16(1)], -1), np.zeros((1, 1)), 1000.0, None)
    assert sensor.signal(colored).shape == (6, 8, 3)


def test_a_plateau_is_saturation_but_a_dark_picture_is_not():
    value = np.random.default_rng(0).integers(200, 700, (90, 90))
    assert sensor.saturation(mosaic(value)) == 1100
    assert sensor.saturation(mosaic(np.minimum(value + 350, 900))) == 900
    assert sensor.saturation(mosaic(np.full((90, 90), 300))) == 1100


def test_rounding_of_whole_counts():
    assert sensor.rounding_variance(mosaic(np.zeros((4, 4)), black=[[100]])) == pytest.approx(1 / 12 / 1000**2)
