"""The atlas: charts without overlap, one point of the surface for each texel."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from polcap.fusion import atlas as atlases
from polcap.fusion.atlas import Atlas, AtlasSettings
from polcap.image_values import Floats
from polcap.optics.frames import angle_deg
from tests.fusion import ellipsoid


def signed_areas(atlas: Atlas) -> Floats:
    """Twice the area (F,) of each triangle in the texture, whose side is 1."""
    corner = atlas.mesh.uv[atlas.mesh.faces]
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]


def test_charts_do_not_overlap(atlas: Atlas) -> None:
    assert atlas.covered.mean() == pytest.approx(np.abs(signed_areas(atlas)).sum() / 2, rel=0.01)


def test_all_triangles_face_the_reader_of_the_texture(atlas: Atlas) -> None:
    """Only then the handedness of every tangent is 1."""
    assert (signed_areas(atlas) < 0).all()  # v runs down


def test_texels_lie_on_the_surface_with_its_normals(atlas: Atlas) -> None:
    inside = np.sum((atlas.position / ellipsoid.AXES) ** 2, axis=-1)
    assert np.abs(inside - 1).max() < 0.02
    assert angle_deg(atlas.normal, ellipsoid.normals(atlas.position)).max() < 2


def test_a_texel_is_no_larger_than_a_pixel_of_the_maps() -> None:
    views = ellipsoid.views(1)
    found = atlases.unwrap(ellipsoid.mesh(), views, AtlasSettings())
    pixel = ellipsoid.DISTANCE / views[0].camera.focal
    assert 0.2 < found.texel / pixel <= 1.05


def test_a_dense_mesh_is_reduced_to_what_the_maps_resolve() -> None:
    views, dense = ellipsoid.views(1), ellipsoid.mesh()
    views = tuple(replace(one, camera=replace(one.camera, focal=one.camera.focal / 4)) for one in views)
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
