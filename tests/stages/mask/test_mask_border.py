"""Pixels on the outline of a mask."""

import numpy as np
import pytest

from polcap.stages.mask import mask_border


@pytest.mark.parametrize("off", [-0.5, 0, 0.5])
def test_pixels_on_the_outline_belong_to_the_object_by_their_coverage(off):
    y, x = np.mgrid[:640, :640] / 8 - 39.94
    covered = (np.hypot(x, y) < 20).reshape(80, 8, 80, 8).mean(axis=(1, 3))
    mask = np.hypot(*np.mgrid[-39.5:40, -39.5:40]) < 20 + off
    picture = np.repeat((0.01 + 0.49 * covered)[..., None], 3, axis=2).astype(np.float32)
    share = (np.sqrt(picture[..., 0]) - 0.1) / (np.sqrt(0.5) - 0.1)
    assert np.array_equal(mask_border.refine(picture, mask), share > 0.25)


def test_pixels_stay_where_object_and_backdrop_have_one_color():
    mask = np.hypot(*np.mgrid[-39.5:40, -39.5:40]) < 20
    assert np.array_equal(mask_border.refine(np.full((80, 80, 3), 0.2, np.float32), mask), mask)
