"""The inverse square, Lambert's cosine, and the cosine power of a lens."""

import numpy as np
import pytest

from polcap.optics import point_light

LENS = np.zeros(2)


def test_light_falls_with_the_square_of_the_distance_and_the_cosine():
    ahead = np.array([0.0, 0.0, -1.0])
    assert point_light.irradiance(ahead, LENS, 0.0) == pytest.approx(1.0)
    assert point_light.irradiance(2 * ahead, LENS, 0.0) == pytest.approx(0.25)
    tilted = np.array([np.sin(0.5), 0.0, np.cos(0.5)])
    assert point_light.irradiance(ahead, LENS, 0.0, tilted) == pytest.approx(np.cos(0.5))


def test_a_wall_under_a_flash_at_the_lens_darkens_as_the_cube_of_the_cosine_and_by_the_lens_as_the_seventh():
    """E = cos³ θ on a plane across the axis, × cos⁴ θ of natural falloff."""
    off_axis = np.array([np.tan(0.3), 0.0, -1.0])
    wall = np.array([0.0, 0.0, 1.0])
    assert point_light.irradiance(off_axis, LENS, 0.0, wall) == pytest.approx(np.cos(0.3) ** 3)
    assert point_light.irradiance(off_axis, LENS, 4.0, wall) == pytest.approx(np.cos(0.3) ** 7)


def test_a_plane_turned_away_gets_nothing():
    assert point_light.irradiance(np.array([0.0, 0, -1]), LENS, 0.0, np.array([0.0, 0, -1])) == 0
