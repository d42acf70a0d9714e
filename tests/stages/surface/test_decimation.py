"""Levels of detail: fewer triangles, a stated distance, the same look."""

import numpy as np
import pytest

from polcap.errors import ObjectError
from polcap.optics import frames
from polcap.stages import surface
from polcap.stages.surface import Back
from polcap.stages.surface.triangles import boundary_edges
from tests import surfaces
from tests.stages.test_asset import rendered_normals


@pytest.fixture(scope="module")
def level() -> surface.DecimatedMesh:
    whole = surfaces.mesh(surfaces.maps())
    return surface.decimate(whole, surfaces.VIEW, len(whole.faces) // 16, "open")


def test_a_sixteenth_of_the_triangles_lies_where_it_says(level: surface.DecimatedMesh) -> None:
    """Against the ball itself, which the first mesh follows to within half a pixel."""
    assert len(level.mesh.faces) == pytest.approx(len(surfaces.mesh(surfaces.maps()).faces) / 16, rel=0.1)
    scale = np.nanmedian(surfaces.mesh(surfaces.maps()).depth) / surfaces.VIEW.focal  # m per px
    assert level.error == pytest.approx(level.error_px * scale, rel=1e-3)
    assert 0 < level.error_px < 2


def test_detail_stays_in_the_normal_texture(level: surface.DecimatedMesh) -> None:
    maps = surfaces.maps(ripple=0.2)
    built = surfaces.built(maps, level.mesh)
    seen, (row, column) = rendered_normals(built, maps, within=0.5)
    true = maps.normal[row, column]
    assert frames.angle_deg(seen, true)[true[:, 2] > 0.3].mean() < 4  # vertices lie between pixels: the ripple's own


def test_too_many_levels_are_refused() -> None:
    with pytest.raises(ObjectError, match="fewer levels"):
        surface.decimate(surfaces.mesh(surfaces.maps()), surfaces.VIEW, 1, "open")


@pytest.mark.parametrize("back", ["skirt", "closed"])
@pytest.mark.parametrize("share", [8, 60])
def test_a_back_stays_in_fewer_triangles(back: Back, share: int) -> None:
    """Its walls are slivers; no collapse removes them, so they are made from the reduced front."""
    whole = surfaces.mesh(surfaces.maps(), surface.SurfaceSettings(back=back))
    count = len(whole.faces) // share
    less = surface.decimate(surfaces.mesh(surfaces.maps()), surfaces.VIEW, count, back)
    depth = [np.ptp(mesh.vertices[mesh.faces][..., 2]) for mesh in (whole, less.mesh)]
    assert depth[1] == pytest.approx(depth[0], rel=0.03) and less.error_px < 3
    assert less.mesh.vertices.dtype == less.mesh.normals.dtype == less.mesh.tangents.dtype == np.float32
    assert 0.5 * count < len(less.mesh.faces) <= 1.02 * count
    if back == "closed":
        assert len(boundary_edges(less.mesh.faces)) == 0
