"""The lens's falloff is taken out where it is, in the corners as in the middle."""

import numpy as np
import pytest

from polcap.calibration_values import Falloff
from polcap.image_values import MaskedImage, View
from polcap.stages.hdr import weights

LAW = Falloff(((-0.25, 0.05, 0.0),) * 3, ((0.0, 0.0, 0.0),) * 3, (0.8, 0.8, 0.8), 11.0, 60.0)


def test_light_of_a_falling_off_lens_becomes_even():
    width, height = 60, 40  # of the grid; the RAW has 120 × 80 px
    view = View(100.0, ((119 - 1) / 4, (79 - 1) / 4), 2.0)
    y, x = np.mgrid[0:height, 0:width]
    r2 = (((2 * x + 0.5) - 59.5) ** 2 + ((2 * y + 0.5) - 39.5) ** 2) / (60**2 + 40**2)
    light = (1 - 0.25 * r2 + 0.05 * r2**2)[..., None] * np.array([0.5, 1.0, 0.7])
    value, variance = light.astype(np.float32), (light * 1e-4).astype(np.float32)
    image = MaskedImage(value, variance, np.zeros((height, width), np.uint8))
    weights.divide_by_falloff(image, view, (120, 80), LAW)
    assert value == pytest.approx(np.broadcast_to([0.5, 1.0, 0.7], value.shape), rel=1e-3)
    assert variance * light == pytest.approx(1e-4 * value**2, rel=2e-3)  # the error relative to the light is as before
