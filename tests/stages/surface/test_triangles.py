"""The mesh over a depth map: its frames, boundary and back."""

import msgspec
import numpy as np
import pytest

from polcap.image_values import View
from polcap.stages import surface
from polcap.stages.surface.triangles import boundary_edges
from tests.stages.surface.depth_scenes import SHAPE, VIEW, sphere

SETTINGS = surface.SurfaceSettings()


def test_mesh_faces_the_camera_with_upright_frames() -> None:
    truth_maps, _ = sphere()
    mesh = surface.integrate(truth_maps, 0.95, SETTINGS)
    p, q, r = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    facing = np.sum(np.cross(q - p, r - p) * -p, axis=-1)  # the camera is at the origin
    assert (facing > 0).all()
    u, v = (mesh.uv * [SHAPE[1], SHAPE[0]] - 0.5).T
    assert np.allclose(-mesh.vertices[:, 0] / mesh.vertices[:, 2], (u - VIEW.center[0]) / VIEW.focal, atol=1e-5)
    assert np.allclose(-mesh.vertices[:, 1] / mesh.vertices[:, 2], (VIEW.center[1] - v) / VIEW.focal, atol=1e-5)
    row, column = np.rint(v).astype(int), np.rint(u).astype(int)
    agreement = np.sum(mesh.normals * truth_maps.normal[row, column], axis=-1)
    assert np.percentile(agreement, 5) > np.cos(np.radians(5))
    tangent = mesh.tangents[:, :3]
    assert np.abs(np.sum(tangent * mesh.normals, axis=-1)).max() < 1e-5
    assert np.allclose(np.linalg.norm(tangent, axis=-1), 1, atol=1e-5)
    assert (tangent[:, 0] > 0).all() and (mesh.tangents[:, 3] == 1).all()
    assert (np.cross(mesh.normals, tangent)[:, 1] > 0).mean() > 0.99  # the bitangent points up the picture


def test_vertices_are_no_more_than_the_limit() -> None:
    view = View(800.0, (127.5, 111.5), 1.0)
    truth_maps, _ = sphere(view, (224, 256))
    mesh = surface.integrate(truth_maps, None, surface.SurfaceSettings(max_vertices=3000))
    assert 1500 < len(mesh.vertices) <= 3000
    assert mesh.depth.shape == (224, 256)
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_vertices_can_be_moved_from_their_middle_and_back() -> None:
    scene, _ = sphere()
    vertices = surface.integrate(scene, None, SETTINGS).vertices
    middle = (vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2
    assert np.array_equal(((vertices - middle).astype(np.float32) + middle).astype(np.float32), vertices)


def test_boundary_is_smoother_than_pixels() -> None:
    """Distance of the boundary's vertices from the ball's outline, in px of the picture: 1/√12 for pixels' stairs.

    Its depth: a stair of one pixel is ten deep where the surface leans by 84°.
    """
    ball, _ = sphere(View(1000.0, (99.5, 99.5), 1.0), (200, 200), (0.0, 0.0, -1.0), 0.09)
    mesh = surface.integrate(ball, None, SETTINGS)
    edge = np.unique(boundary_edges(mesh.faces))
    away = np.linalg.norm(mesh.uv[edge] * 200 - 100, axis=1)
    assert np.std(away) < 0.2
    follows = dict(boundary_edges(mesh.faces).tolist())
    depth = 1000 * mesh.vertices[:, 2].astype(np.float64)  # px
    bends = [depth[a] - 2 * depth[b] + depth[follows[b]] for a, b in follows.items()]
    assert np.sqrt(np.mean(np.square(bends))) < 0.3
    assert 0 < mesh.raggedness < 0.15


@pytest.mark.parametrize(("back", "holes"), [("open", True), ("skirt", True), ("closed", False)])
def test_back_closes_the_mesh(back: str, holes: bool) -> None:
    truth_maps, _ = sphere()
    seen = surface.integrate(truth_maps, 0.95, SETTINGS)
    mesh = surface.integrate(truth_maps, 0.95, msgspec.structs.replace(SETTINGS, back=back))
    assert bool(len(boundary_edges(mesh.faces))) == holes
    assert (mesh.faces[: len(seen.faces)] == seen.faces).all()
    p, q, r = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    volume = np.sum(p * np.cross(q, r)) / 6
    if back == "closed":
        assert 0.0015 < volume < np.pi * 0.1**3  # the seen cap holds 0.0018, the cylinder about a half more
