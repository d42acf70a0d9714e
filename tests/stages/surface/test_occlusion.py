"""Contacts of two parts, against occluding contours."""

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.stages.surface.multigrid import PixelGrid
from polcap.stages.surface.occlusion import contact_links

SIZE = 60
RADIUS = SIZE / np.sqrt(np.pi)


def left_before_right(jump: Floats) -> tuple[PixelGrid, np.ndarray, Floats]:
    """A square cut down its middle, its left half before the right by `jump` (SIZE,) px."""
    grid = PixelGrid(np.ones((SIZE, SIZE), dtype=bool))
    separate = (np.arange(len(grid.p)) < grid.first_down) & (grid.column[grid.p] == SIZE // 2 - 1)
    return grid, separate, np.where(separate, jump[grid.row[grid.p]], 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_least_jump_held_along_a_stretch_is_a_contact(side: float) -> None:
    row = np.arange(SIZE)
    jump = RADIUS * (0.2 + 0.02 * np.maximum(row - 25, 0))  # a crease of 26 px, then an occluding contour
    grid, separate, excess = left_before_right(side * jump)
    touch = contact_links(grid, separate, excess, RADIUS)
    assert touch[separate][:25].all()
    assert not touch[separate][30:].any() and not touch[~separate].any()


def test_step_that_varies_is_no_contact() -> None:
    jump = RADIUS * (0.2 + 0.01 * np.abs(np.arange(SIZE) - SIZE / 2))  # never the same for long
    assert not contact_links(*left_before_right(jump), RADIUS).any()


def test_part_that_is_a_speck_touches_nothing() -> None:
    grid = PixelGrid(np.ones((SIZE, SIZE), dtype=bool))
    separate = (grid.p == 0) | (grid.q == 0)
    assert not contact_links(grid, separate, np.where(separate, 5.0, 0.0), 1.0).any()
