"""Parts that touch along a crease are told from parts that stand apart."""

import numpy as np
import pytest

from polcap.images import Floats
from polcap.stages.surface import contacts
from polcap.stages.surface.pixel_grid import PixelGrid

SIZE = 60
RADIUS = SIZE / np.sqrt(np.pi)


def left_before_right(jump: Floats) -> tuple[PixelGrid, np.ndarray, Floats]:
    """A square parted down its middle, its left half before the right by jump (SIZE,) px."""
    grid = PixelGrid(np.ones((SIZE, SIZE), dtype=bool))
    apart = (np.arange(len(grid.p)) < grid.turn) & (grid.column[grid.p] == SIZE // 2 - 1)
    return grid, apart, np.where(apart, jump[grid.row[grid.p]], 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_least_jump_held_along_a_stretch_is_a_contact(side: float) -> None:
    row = np.arange(SIZE)
    jump = RADIUS * (0.2 + 0.02 * np.maximum(row - 25, 0))  # a crease of 26 px, then a limb
    grid, apart, excess = left_before_right(side * jump)
    touch = contacts.contacts(grid, apart, excess, RADIUS)
    assert touch[apart][:25].all()
    assert not touch[apart][30:].any() and not touch[~apart].any()


def test_limb_before_something_far_behind_is_no_contact() -> None:
    jump = RADIUS * (0.2 + 0.01 * np.abs(np.arange(SIZE) - SIZE / 2))  # never the same for long
    assert not contacts.contacts(*left_before_right(jump), RADIUS).any()


def test_part_that_is_a_speck_touches_nothing() -> None:
    grid = PixelGrid(np.ones((SIZE, SIZE), dtype=bool))
    apart = (grid.p == 0) | (grid.q == 0)
    assert not contacts.contacts(grid, apart, np.where(apart, 5.0, 0.0), 1.0).any()
