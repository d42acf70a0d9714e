"""Views of simple bodies are joined into closed meshes of the right size."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

pytest.importorskip("skimage")
pytest.importorskip("manifold3d")
pytest.importorskip("embreex")

from polcap.errors import ObjectError
from polcap.fusion.closed_mesh import decimate, is_closed, iso_surface
from polcap.fusion.hull import DistanceGrid, VoxelGrid, plain_body, visual_hull
from polcap.fusion.shape import ShapeSettings, fuse_shape
from polcap.fusion.small_views import reduce_views
from polcap.fusion.values import ClosedMesh, FusionView
from polcap.optics import frames
from tests.fusion.traced_views import SIZE, Body, all_around, capture, into_the_opening, ring, solid, stand, with_errors

GRID, PIXELS = 40, 96  # of the fused body, and of a view


def fuse(views: list[FusionView]) -> ClosedMesh:
    return fuse_shape(views, ShapeSettings(grid=GRID))


@pytest.fixture(scope="module")
def ball() -> Body:
    sphere = trimesh.creation.icosphere(4)
    return stand(sphere.vertices, sphere.faces)


@pytest.fixture(scope="module")
def fused_ball(ball: Body) -> ClosedMesh:
    rng = np.random.default_rng(0)
    views = [with_errors(ball, capture(ball, pose, PIXELS), rng) for pose in all_around(ball, 9)]
    return fuse(views)


def test_a_ball_has_its_radius_where_normals_and_poses_err(ball: Body, fused_ball: ClosedMesh) -> None:
    radius = np.linalg.norm(fused_ball.vertices - ball.middle, axis=1)
    assert abs(radius.mean() - SIZE / 2) < 0.003 * SIZE  # ¼ px of these views, and the errors of their poses
    assert radius.std() < 0.006 * SIZE


def test_the_hull_of_views_from_far_above_is_closed_and_ends_at_the_board(ball: Body) -> None:
    hull = visual_hull(reduce_views([capture(ball, pose, PIXELS) for pose in ring(ball, 6, elevation_deg=60)]), GRID)
    mesh = iso_surface(hull)
    assert is_closed(mesh)
    assert mesh.vertices[:, 1].min() > -3 * hull.grid.step


def test_the_mesh_is_closed_manifold_and_outward(fused_ball: ClosedMesh) -> None:
    assert is_closed(fused_ball)
    assert solid(fused_ball).euler_number == 2
    assert solid(fused_ball).volume == pytest.approx(np.pi / 6 * SIZE**3, rel=0.02)
    assert solid(fused_ball).is_volume


def test_levels_are_closed_and_have_their_number_of_triangles(fused_ball: ClosedMesh) -> None:
    for count in (2000, 500):
        level = decimate(fused_ball, count)
        assert is_closed(level) and solid(level).volume > 0
        assert len(level.faces) == pytest.approx(count, rel=0.02)


def test_normals_that_lie_in_the_surface_do_not_fold_it(ball: Body) -> None:
    views = []
    for pose in all_around(ball, 9):
        view = capture(ball, pose, PIXELS)
        axis = pose.rotation @ [1.0, 0, 0]
        across = frames.unit(np.cross(axis, view.normal) + 1e-6).astype(np.float32)
        views.append(replace(view, normal=np.where((view.normal @ axis > 0.8)[..., None], across, view.normal)))
    fused = fuse(views)
    outside = np.max([view.distance(fused.vertices) for view in reduce_views(views)])
    assert outside < SIZE / GRID  # nothing leaves the hull by a step
    assert np.mean(solid(fused).face_adjacency_angles > np.radians(100)) < 1e-3


def test_a_torus_keeps_its_hole() -> None:
    torus = trimesh.creation.torus(1.0, 0.35, 48, 24)
    body = stand(torus.vertices, torus.faces)  # upright
    views = [capture(body, pose, PIXELS) for pose in ring(body, 8)]
    fused = fuse(views)
    assert solid(fused).euler_number == 0 and is_closed(fused)


def test_a_dent_that_no_silhouette_shows_has_its_depth() -> None:
    sphere = trimesh.creation.icosphere(5)
    angle = np.arccos(np.clip(sphere.vertices[:, 2], -1, 1))
    depth = 0.15 * np.exp(-((angle / 0.45) ** 2))
    body = stand(sphere.vertices * (1 - depth)[:, None], sphere.faces)
    views = [capture(body, pose, PIXELS) for pose in all_around(body, 9)]
    fused = fuse(views)
    start = body.middle + np.array([0, 0, SIZE])
    met = trimesh.Trimesh(fused.vertices, fused.faces).ray.intersects_location([start], [[0, 0, -1.0]])[0][:, 2].max()
    true = trimesh.Trimesh(body.triangles.vertices, body.triangles.faces)
    bottom = true.ray.intersects_location([start], [[0, 0, -1.0]])[0][:, 2].max()
    assert met == pytest.approx(bottom, abs=0.003 * SIZE)  # of a dent of 7.5 % of the size


def test_parts_that_touch_by_an_edge_alone_are_not_joined() -> None:
    distance = np.full((9, 9, 9), 0.2, np.float32)  # so near the surface that the edge could as well be inside
    distance[2:7, 2:7, 2] = distance[2:7, 2, 2:7] = -1  # an L
    distance[4, 3, 6] = distance[4, 4, 6] = distance[4, 4, 5] = distance[4, 5, 4] = distance[4, 5, 3] = -1  # a strut
    body = plain_body(distance, 1.0)
    assert body[4, 5, 3] < 0 and body[4, 4, 5] < 0
    mesh = iso_surface(DistanceGrid(VoxelGrid(np.zeros(3), 1.0, (9, 9, 9)), body))
    assert is_closed(mesh) and solid(mesh).euler_number == 2


def test_a_thin_wall_with_a_window_is_no_handle() -> None:
    distance = np.ones((40, 40, 40), np.float32)
    distance[4:36, 4:36, 4:12] = distance[4:36, 4:7, 12:36] = -1  # a wall of three steps on a block
    distance[12:28, 4:7, 18:30] = 1
    assert np.array_equal(plain_body(distance, 1.0) < 0, distance < 0)


@pytest.fixture(scope="module")
def bowl() -> Body:
    profile = [[0, 0], [0.6, 0], [1, 0.9], [0.85, 0.9], [0.5, 0.15], [0, 0.15]]  # radius and height
    turned = trimesh.creation.revolve(np.array(profile), sections=64).subdivide_to_size(0.1)
    return stand(turned.vertices[:, [0, 2, 1]] * [1, 1, -1], turned.faces)  # the axis upwards


@pytest.fixture(scope="module")
def fused_bowl(bowl: Body) -> ClosedMesh:
    """Of views with errors, of which one has a mask that is too narrow."""
    rng = np.random.default_rng(0)
    views = [with_errors(bowl, capture(bowl, pose, PIXELS), rng) for pose in into_the_opening(bowl, 10)]
    views[0] = replace(views[0], mask=views[0].mask & np.roll(views[0].mask, PIXELS // 20, axis=1))
    return fuse(views)


def test_a_bowl_is_hollow(bowl: Body, fused_bowl: ClosedMesh) -> None:
    filled = np.pi * (SIZE / 2) ** 3 * 0.9 * (1 + 0.6 + 0.36) / 3  # the bowl with a lid, a frustum
    true = abs(trimesh.Trimesh(bowl.triangles.vertices, bowl.triangles.faces).volume)
    assert is_closed(fused_bowl)
    assert true < 0.5 * filled
    assert solid(fused_bowl).volume == pytest.approx(true, abs=0.2 * filled)


def test_a_mask_that_is_too_narrow_leaves_no_hole_in_a_bowl(fused_bowl: ClosedMesh) -> None:
    assert solid(fused_bowl).euler_number == 2


def test_views_that_look_past_each_other_are_refused(ball: Body) -> None:
    views = [capture(ball, pose, 64) for pose in all_around(ball, 3)]
    views[0].pose.translation[0] += 2 * SIZE
    with pytest.raises(ObjectError, match="no point in common"):
        fuse(views)
