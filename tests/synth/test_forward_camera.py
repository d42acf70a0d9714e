"""Simulated sensor: color filter of each photosite, noise and saturation."""

import numpy as np
import pytest

from polcap.synth import forward_camera
from polcap.synth.forward_camera import Sensor


def test_each_photosite_measures_the_color_of_its_filter() -> None:
    image = np.broadcast_to(np.array([1.0, 2.0, 3.0]), (4, 6, 3))
    mosaic = forward_camera.mosaic(image, np.array([[1, 0], [2, 1]], np.uint8))  # GRBG
    np.testing.assert_array_equal(mosaic[:2, :2], [[2, 1], [3, 2]])
    np.testing.assert_array_equal(mosaic, np.tile(mosaic[:2, :2], (2, 3)))


@pytest.mark.parametrize("amplification", [1.0, 4.0])
def test_variance_is_photons_plus_read_noise(amplification: float) -> None:
    sensor = Sensor(full_well=20000, read_noise=5)
    per_electron = amplification * (sensor.white - sensor.black) / sensor.full_well
    for level in (0.0, 0.01, 0.2):
        counts = forward_camera.expose(np.full(200_000, level), sensor, amplification, np.random.default_rng(1))
        electrons = level * sensor.full_well
        variance = per_electron**2 * (electrons + 25) + 1 / 12  # and rounding
        assert counts.mean() - sensor.black == pytest.approx(per_electron * electrons, abs=4 * (variance / 2e5) ** 0.5)
        assert counts.var() == pytest.approx(variance, rel=0.02)  # 6 σ of a variance over 2·10⁵


def test_counts_end_at_the_white_level_and_at_zero() -> None:
    sensor = Sensor(black=2, read_noise=30)
    counts = forward_camera.expose(np.array([[0.0] * 500, [5.0] * 500]), sensor, 1.0, np.random.default_rng(0))
    assert counts[0].min() == 0 and counts[1].max() == sensor.white
    assert (counts[1] > 0.99 * sensor.white).all()
