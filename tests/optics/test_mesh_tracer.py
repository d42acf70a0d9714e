"""Traced triangle meshes against the closed forms of spheres and boxes."""

import numpy as np
import pytest

pytest.importorskip("embreex")

from polcap.image_values import Floats, View
from polcap.optics import frames, mesh_tracer
from polcap.training import random_shapes

SIZE = 96
VIEW = View(focal=300.0, center=(47.5, 47.5), scale=1.0)
FAR = np.array([0.0, 0.0, -3.0])


def ball(
    radius: float = 0.4, centre: tuple[float, float, float] = (0, 0, 0), steps: int = 128
) -> mesh_tracer.Triangles:
    unit, faces = random_shapes._sphere(steps, 2 * steps)
    return mesh_tracer.smooth(radius * unit + np.array(centre), faces)


def hit_ball(radius: float, centre: Floats) -> Floats:
    """Depth along the optical axis at which each pixel's ray meets a ball, NaN where it misses."""
    x, y = (np.arange(SIZE) - 47.5) / 300, (np.arange(SIZE) - 47.5) / 300
    d = np.stack([*np.meshgrid(x, -y), -np.ones((SIZE, SIZE))], -1)  # depth 1 along each ray
    dd, dc = np.sum(d * d, -1), d @ centre
    root = dc**2 - dd * (centre @ centre - radius**2)
    return np.where(root >= 0, (dc - np.sqrt(np.maximum(root, 0))) / dd, np.nan)


def test_ball_has_the_depth_and_normals_of_a_sphere() -> None:
    seen = mesh_tracer.Tracer(ball()).trace(np.eye(3), FAR, VIEW, SIZE, SIZE)
    truth = hit_ball(0.4, FAR)
    both = seen.mask & np.isfinite(truth)
    assert (seen.mask ^ np.isfinite(truth)).mean() < 0.005  # facets cut the outline by a fraction of a pixel
    inner = both & (seen.normal[..., 2] > 0.3)
    assert np.abs(seen.depth - truth)[inner].max() < 2e-3
    point = seen.position[both]
    np.testing.assert_allclose(np.linalg.norm(point, axis=1), 0.4, atol=1e-3)
    assert frames.angle_deg(seen.normal[both], frames.unit(point)).max() < 1.5


def test_first_hits_are_infinitely_far_where_a_ray_misses() -> None:
    origin, ahead = np.array([[0.0, 0, 3], [0.3, 0, 3], [2, 0, 3]]), np.tile([0.0, 0, -1], (3, 1))
    distance, normal = mesh_tracer.Tracer(ball()).first_hits(origin, ahead)
    np.testing.assert_allclose(distance, [2.6, 3 - np.sqrt(0.4**2 - 0.3**2), np.inf], atol=2e-3)
    np.testing.assert_allclose(normal[:2], [[0, 0, 1], [0.75, 0, np.sqrt(1 - 0.75**2)]], atol=0.03)


def test_turned_camera_sees_turned_normals() -> None:
    """Normals are in the camera's frame, positions in the object's: n_camera = R n_object on a ball."""
    turn = np.array([[0.0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]])
    seen = mesh_tracer.Tracer(ball()).trace(turn, FAR + np.array([0.1, -0.05, 0]), VIEW, SIZE, SIZE)
    inside = seen.mask & (seen.normal[..., 2] > 0.2)
    np.testing.assert_allclose(seen.normal[inside], seen.position[inside] @ turn.T / 0.4, atol=0.02)


def test_overlapping_meshes_are_seen_as_their_union() -> None:
    near = np.array([0.15, 0.0, 0.2])
    both_balls = mesh_tracer.union([ball(), ball(0.2, tuple(near))])
    seen = mesh_tracer.Tracer(both_balls).trace(np.eye(3), FAR, VIEW, SIZE, SIZE)
    truth = np.fmin(hit_ball(0.4, FAR), hit_ball(0.2, FAR + near))
    both = seen.mask & np.isfinite(truth)
    assert np.median(np.abs(seen.depth - truth)[both]) < 1e-3
    assert np.quantile(np.abs(seen.depth - truth)[both], 0.98) < 0.01


def test_edges_of_a_box_stay_sharp_and_a_seam_does_not_show() -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float) * 0.3
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    box = mesh_tracer.smooth(corners, faces)
    assert np.abs(np.abs(box.corner_normals).max(axis=-1) - 1).max() < 1e-6  # each along one axis
    whole = ball(steps=24)
    split = mesh_tracer.smooth(whole.vertices[whole.faces].reshape(-1, 3), np.arange(whole.faces.size).reshape(-1, 3))
    np.testing.assert_allclose(split.corner_normals, whole.corner_normals, atol=1e-5)


def test_normals_face_the_camera_even_inside_an_open_bowl() -> None:
    bowl = ball()
    upper = mesh_tracer.Triangles(bowl.vertices, bowl.faces[: len(bowl.faces) // 2], bowl.corner_normals)
    turn = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # look into it
    seen = mesh_tracer.Tracer(upper).trace(turn, FAR, VIEW, SIZE, SIZE)
    facing = np.sum(seen.normal * frames.rays(VIEW, SIZE, SIZE), axis=-1)
    assert facing[seen.mask].min() > 0
