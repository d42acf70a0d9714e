"""Dilation and erosion by squares are dual; only erosion from the border removes pixels at the picture's edge."""

import numpy as np

from polcap.optics.morphology import dilate, erode, masked_mean

MASK = np.zeros((9, 12), bool)
MASK[4, 5] = MASK[0, 0] = True


def test_a_pixel_grows_to_a_square() -> None:
    grown = dilate(MASK, 2)
    assert grown[2:7, 3:8].all() and grown[:3, :3].all() and grown.sum() == 25 + 9


def test_erosion_is_dilation_of_the_background() -> None:
    mask = np.random.default_rng(0).random((40, 50)) < 0.9
    assert np.array_equal(erode(mask, 1), ~dilate(~mask, 1))
    assert 0 < erode(mask, 1).sum() < mask.sum()


def test_only_erosion_from_the_border_removes_pixels_at_the_edge() -> None:
    full = np.ones((6, 7), bool)
    full.setflags(write=False)  # as arrays of the cache are
    assert erode(full, 2).all()
    assert np.array_equal(
        np.argwhere(erode(full, 2, from_border=True)), [[2, 2], [2, 3], [2, 4], [3, 2], [3, 3], [3, 4]]
    )


def test_a_masked_mean_ignores_pixels_outside() -> None:
    """An even picture stays even up to the mask's edge, whatever is outside, also NaN."""
    inside = np.zeros((20, 20), bool)
    inside[5:15, 4:12] = True
    even = np.where(inside[..., None], [2.0, 3.0], np.nan)
    np.testing.assert_allclose(masked_mean(even, inside, 2.0)[inside], np.tile([2.0, 3.0], (80, 1)), rtol=1e-5)
    np.testing.assert_allclose(masked_mean(even[..., 1], inside, 2.0)[inside], 3.0, rtol=1e-5)
