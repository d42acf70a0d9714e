"""Parts that a mask lacks are added where they are bright before the backdrop."""

import numpy as np
import pytest

from polcap.image_values import Bools, Floats
from polcap.stages.mask import bright_parts

NOWHERE = np.zeros((120, 130), bool)
BODY, LEG, APART = np.s_[30:60, 40:90], np.s_[60:75, 50:54], np.s_[85:95, 20:30]


def picture(backdrop: float) -> Floats:
    value = np.full((120, 130, 3), backdrop, np.float32)
    for part in (BODY, LEG, APART):
        value[part] = 0.4
    return value


def mask_of(*parts: tuple[slice, slice]) -> Bools:
    mask = np.zeros((120, 130), bool)
    for part in parts:
        mask[part] = True
    return mask


def test_a_bright_leg_is_added_and_what_is_not_joined_to_the_mask_is_not():
    assert np.array_equal(bright_parts.add(picture(0.02), mask_of(BODY), NOWHERE), mask_of(BODY, LEG))


@pytest.mark.parametrize("backdrop", [0.15, 0.5])
def test_nothing_is_added_before_a_backdrop_that_is_not_dark(backdrop):
    assert np.array_equal(bright_parts.add(picture(backdrop), mask_of(BODY), NOWHERE), mask_of(BODY))


def test_masks_without_backdrop_and_empty_masks_stay():
    for mask in (mask_of(), mask_of(np.s_[:, :])):
        assert np.array_equal(bright_parts.add(picture(0.02), mask, NOWHERE), mask)


def test_an_erased_print_is_not_added():
    assert np.array_equal(bright_parts.add(picture(0.02), mask_of(BODY), mask_of(LEG)), mask_of(BODY))
