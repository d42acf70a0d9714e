"""The atlas: charts without overlap, one point of the surface for each texel."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from polcap.fusion import atlas as atlases
from polcap.fusion.atlas import Atlas, AtlasSettings
from tests.fusion import ellipsoid

SIDE = 256


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return atlases.chart(ellipsoid.mesh(), SIDE, 6)


def test_charts_do_not_overlap(atlas: Atlas) -> None:
    corner = atlas.mesh.uv[atlas.mesh.faces] * SIDE
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).sum() / 2
    assert atlas.covered.sum() == pytest.approx(area, rel=0.01)


def test_all_triangles_face_the_reader_of_the_texture(atlas: Atlas) -> None:
    """Only then the handedness of every tangent is 1."""
    corner = atlas.mesh.uv[atlas.mesh.faces]
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    assert (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] < 0).all()  # v runs down


def test_texels_lie_on_the_surface_with_its_normals(atlas: Atlas) -> None:
    inside = np.sum((atlas.position / ellipsoid.AXES) ** 2, axis=-1)
    assert np.abs(inside - 1).max() < 0.02
    truth = ellipsoid.normals(atlas.position)
    assert np.degrees(np.arccos(np.clip(np.sum(atlas.normal * truth, axis=-1), -1, 1))).max() < 2


def test_the_mesh_is_closed_when_its_vertices_are_joined_by_position(atlas: Atlas) -> None:
    trimesh = pytest.importorskip("trimesh")
    read = trimesh.Trimesh(atlas.mesh.vertices, atlas.mesh.faces, process=False)
    assert not read.is_watertight  # the charts are parted
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight and read.volume > 0


def test_a_texel_is_no_larger_than_a_pixel_of_the_maps() -> None:
    views = ellipsoid.views(1)
    found = atlases.unwrap(ellipsoid.mesh(), views, AtlasSettings())
    pixel = ellipsoid.DISTANCE / views[0].view.focal
    assert 0.2 < found.texel / pixel <= 1.05


def test_a_dense_mesh_is_reduced_to_what_the_maps_resolve() -> None:
    views, dense = ellipsoid.views(1), ellipsoid.mesh()
    views = tuple(replace(one, view=replace(one.view, focal=one.view.focal / 4)) for one in views)
    found = atlases.unwrap(dense, views, AtlasSettings())
    assert 1900 < len(found.mesh.faces) < len(dense.faces)


def test_a_mesh_on_which_the_solver_fails_is_reduced_further(monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):  # as Rust's panics are named in Python
        pass

    uvunwrap = pytest.importorskip("uvunwrap")
    views, generate, calls = ellipsoid.views(1), uvunwrap.generate, list[int]()

    def failing(meshes: list[Any], **options: Any) -> Any:
        calls.append(len(meshes))
        if len(calls) == 1:
            raise PanicException("index out of bounds")
        return generate(meshes, **options)

    whole = atlases.unwrap(ellipsoid.mesh(), views, AtlasSettings())
    monkeypatch.setattr(uvunwrap, "generate", failing)
    found = atlases.unwrap(ellipsoid.mesh(), views, AtlasSettings())
    assert 0.85 < len(found.mesh.faces) / len(whole.mesh.faces) < 0.95
