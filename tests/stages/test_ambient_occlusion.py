"""Ambient occlusion against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.image_values import Floats, View
from polcap.stage_values import SurfaceMaps
from polcap.stages.asset.ambient_occlusion import ambient_occlusion
from tests import surfaces

SIDE = 200
VIEW = View(focal=2000.0, center=((SIDE - 1) / 2, (SIDE - 1) / 2), scale=1.0)


def maps(normal: Floats, mask: Floats) -> SurfaceMaps:
    made = surfaces.maps()
    return replace(made, normal=normal.astype(np.float32), mask=mask > 0, view=VIEW)


def test_nothing_hides_the_light_from_a_plane() -> None:
    normal = np.zeros((SIDE, SIDE, 3))
    normal[..., 2] = 1
    seen = ambient_occlusion(maps(normal, np.ones((SIDE, SIDE))), np.full((SIDE, SIDE), 1.0))
    assert np.allclose(seen, 1, atol=1e-4)


@pytest.mark.parametrize("opening_deg", [45, 60])
def test_a_spherical_bowl_hides_its_share_of_the_sphere(opening_deg: float) -> None:
    """Each point of a sphere receives light from all others in proportion to their area."""
    row, column = np.mgrid[:SIDE, :SIDE]
    x, y = (column - VIEW.center[0]) / VIEW.focal, -(row - VIEW.center[1]) / VIEW.focal
    edge = 0.04  # radius of the bowl's edge, as a share of the distance
    radius = edge / np.sin(np.radians(opening_deg))
    inside = x**2 + y**2 < edge**2
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0))
    normal = np.where(inside[..., None], np.stack([-x, -y, z], axis=-1) / radius, 0)
    seen = ambient_occlusion(maps(normal, inside), np.where(inside, 1 + z, np.nan))
    middle = x**2 + y**2 < (0.8 * edge) ** 2
    assert seen[middle].mean() == pytest.approx(1 - (1 - np.cos(np.radians(opening_deg))) / 2, abs=0.03)
