"""Resampling."""

import numpy as np

from polcap.optics.warp import covered, warp


def shift(dx: float, dy: float) -> np.ndarray:
    return np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])


def test_a_parabola_is_shifted_exactly():
    y, x = np.mgrid[0:40, 0:60].astype(float)
    moved = warp((0.01 * x * x - 0.3 * y).astype(np.float32), shift(0.3, -0.4))
    expected = 0.01 * (x + 0.3) ** 2 - 0.3 * (y - 0.4)
    inner = np.s_[10:-10, 10:-10]
    assert np.allclose(moved[inner], expected[inner], atol=2e-4)  # float32 spline coefficients of values up to 35


def test_a_box_is_a_crop_of_the_whole():
    image = np.random.default_rng(1).random((30, 40, 3)).astype(np.float32)
    whole = warp(image, shift(0.4, 0.2))
    assert np.allclose(warp(image, shift(0.4, 0.2), (5, 6, 25, 20)), whole[6:20, 5:25], atol=1e-5)


def test_pixels_beyond_the_image_are_not_covered():
    inside = covered((10, 12), shift(3, 0), (0, 0, 12, 10), margin=0)
    assert inside[:, :9].all() and not inside[:, 9:].any()
