"""Normals to depth to mesh: scenes whose depth is known in closed form."""

import json
import os
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, SurfaceMaps, View
from polcap.stages import surface
from polcap.stages.surface import integration
from polcap.stages.surface.slope_equations import normal_field
from polcap.stages.surface.triangles import boundary_edges

SETTINGS = surface.SurfaceSettings()
VIEW = View(focal=400.0, center=(63.5, 55.5), scale=2.0)
SHAPE = (112, 128)


def slopes(view: View = VIEW, shape: tuple[int, int] = SHAPE) -> tuple[Floats, Floats]:
    """a, b of every pixel: its point is d (a, b, −1)."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    return (column - view.center[0]) / view.focal, -(row - view.center[1]) / view.focal


def maps(normal: Floats, mask: NDArray[np.bool_], view: View = VIEW) -> SurfaceMaps:
    flat = np.ones((*mask.shape, 3), dtype=np.float32)
    return SurfaceMaps(
        normal=normal.astype(np.float32),
        diffuse=0.5 * flat,
        specular=0.04 * flat,
        roughness=0.5 * flat[..., 0],
        depth_prior=None,
        confidence=5 * flat[..., 0],
        mask=mask,
        view=view,
        estimator="truth",
    )


def sphere(
    view: View = VIEW,
    shape: tuple[int, int] = SHAPE,
    center: tuple[float, float, float] = (0.02, 0.01, -1.0),
    radius: float = 0.1,
) -> tuple[SurfaceMaps, Floats]:
    """A sphere about 1 m away, and its depth [m]."""
    a, b = slopes(view, shape)
    ray = np.stack([a, b, -np.ones_like(a)], axis=-1)
    along, square = ray @ np.array(center), np.sum(ray * ray, axis=-1)
    root = along**2 - square * (np.dot(center, center) - radius**2)
    mask = root > 1e-4 * radius**2
    depth = (along - np.sqrt(np.maximum(root, 0))) / square
    normal = (ray * depth[..., None] - center) / radius
    return maps(np.where(mask[..., None], normal, 0), mask, view), np.where(mask, depth, np.nan)


def from_depth(d: Floats, view: View = VIEW) -> Floats:
    """Normals of a depth map by central differences."""
    a, b = slopes(view, d.shape)
    point = d[..., None] * np.stack([a, b, -np.ones_like(a)], axis=-1)
    down, right = np.gradient(point, axis=(0, 1))
    normal = np.cross(right, -down)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def error_share(mesh: Mesh, truth: Floats, mask: NDArray[np.bool_]) -> float:
    """RMSE after the best scale, over the depth range."""
    d, t = mesh.depth[mask].astype(np.float64), truth[mask]
    scale = (d @ t) / (d @ d)
    return float(np.sqrt(np.mean((scale * d - t) ** 2)) / np.ptp(t))


def test_sphere_in_perspective() -> None:
    truth_maps, truth = sphere()
    mesh = surface.integrate(truth_maps, 0.95, SETTINGS)
    assert error_share(mesh, truth, truth_maps.mask) < 0.01  # the limb is a pixel wide and infinitely steep
    assert np.isnan(mesh.depth[~truth_maps.mask]).all()


def test_bumps_are_recovered_to_a_thousandth() -> None:
    a, b = slopes()
    truth = 1 + 0.01 * np.sin(40 * a) * np.cos(35 * b) + 0.1 * a
    mask = (a / 0.14) ** 2 + (b / 0.12) ** 2 < 1
    mesh = surface.integrate(maps(from_depth(truth), mask), None, SETTINGS)
    assert error_share(mesh, truth, mask) < 0.001


def test_pyramid_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    truth_maps, truth = sphere()
    monkeypatch.setattr(integration, "_DECISION_PIXELS", 500)
    mesh = surface.integrate(truth_maps, 0.95, SETTINGS)
    assert error_share(mesh, truth, truth_maps.mask) < 0.01


def ball_in_a_ramp() -> tuple[SurfaceMaps, Floats, NDArray[np.bool_]]:
    """A ball sunk into a plane that recedes upwards: it hides the plane above, and meets it below."""
    _, b = slopes()
    ball, near = sphere(center=(0.0, 0.0, -1.0), radius=0.06)
    ramp = 1 / (1 - 0.8 * b)
    front = ball.mask & (np.nan_to_num(near, nan=9.0) < ramp)
    normal = np.where(front[..., None], ball.normal, from_depth(ramp))
    return maps(normal, np.ones(SHAPE, dtype=bool)), np.where(front, near, ramp), front


def test_jump_is_kept_as_a_jump_and_cut() -> None:
    scene, truth, front = ball_in_a_ramp()
    offset = []  # of the ball against the ramp, px of depth
    for settings in (SETTINGS, surface.SurfaceSettings(stiffness=0.0)):
        depth = surface.integrate(scene, None, settings).depth
        error = depth / np.median(depth) - truth / np.median(truth)
        offset.append(abs(np.median(error[front]) - np.median(error[~front])) * VIEW.focal)
    assert offset[0] < 1 < 5 < offset[1]

    mesh = surface.integrate(scene, None, SETTINGS)
    assert error_share(mesh, truth, scene.mask) < 0.015
    log = VIEW.focal * np.log(-mesh.vertices[..., 2])[mesh.faces]
    assert np.ptp(log, axis=1).max() < 14  # px: what the steepest normal explains; the jump is 24
    joints = np.diff(np.nan_to_num(mesh.depth, nan=0.0), axis=0) * VIEW.focal
    assert np.abs(joints).max() > 20  # it is there, in the depth map


def test_prior_sets_the_offset_between_separate_pieces() -> None:
    a, b = slopes()
    left = a < 0
    mask = np.abs(a) > 0.01
    truth = np.where(left, 1.0, 1.1) + 0.01 * np.sin(60 * b)
    normal = np.where(left[..., None], *(from_depth(d + 0.01 * np.sin(60 * b)) for d in (1.0 + 0 * a, 1.1 + 0 * a)))
    scene = maps(normal, mask)
    alone = error_share(surface.integrate(scene, None, SETTINGS), truth, mask)
    radius = np.sqrt(mask.sum() / np.pi) / VIEW.focal
    coarse = (np.where(left, 1.0, 1.1) / 1.05 - 1) / radius
    guided = replace(scene, depth_prior=coarse.astype(np.float32))
    assert alone > 0.2
    assert error_share(surface.integrate(guided, None, SETTINGS), truth, mask) < 0.05


def test_doubtful_normals_count_less() -> None:
    truth_maps, truth = sphere()
    rng = np.random.default_rng(3)
    bad = np.zeros(SHAPE, dtype=bool)
    bad[40:60, 40:90] = True
    normal = truth_maps.normal + np.where(bad[..., None], rng.normal(0, 0.5, (*SHAPE, 3)), 0)
    normal[bad] += [0.5, 0, 0]
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    blind = replace(truth_maps, normal=normal.astype(np.float32))
    warned = replace(blind, confidence=np.where(bad, 60, 2).astype(np.float32))
    errors = [error_share(surface.integrate(m, None, SETTINGS), truth, truth_maps.mask) for m in (blind, warned)]
    assert errors[1] < 0.7 * errors[0]


def test_distance_is_the_median_depth_in_metres() -> None:
    truth_maps, _ = sphere()
    known, unknown = (surface.integrate(truth_maps, distance, SETTINGS) for distance in (0.7, None))
    assert known.metric and not unknown.metric
    assert np.nanmedian(known.depth) == pytest.approx(0.7, rel=1e-5)
    assert np.nanmedian(unknown.depth) == pytest.approx(1.0, rel=1e-5)
    assert np.allclose(known.vertices, 0.7 * unknown.vertices, rtol=1e-5, atol=2e-7)  # two grids of 1.2e-7


def test_mesh_faces_the_camera_and_keeps_its_frames() -> None:
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


def test_vertices_are_thinned_to_the_limit() -> None:
    view = View(800.0, (127.5, 111.5), 1.0)
    truth_maps, _ = sphere(view, (224, 256))
    mesh = surface.integrate(truth_maps, None, surface.SurfaceSettings(max_vertices=3000))
    assert 1500 < len(mesh.vertices) <= 3000
    assert mesh.depth.shape == (224, 256)
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_empty_object_is_refused() -> None:
    truth_maps, _ = sphere()
    with pytest.raises(ObjectError, match="--mask"):
        surface.integrate(replace(truth_maps, mask=np.zeros(SHAPE, dtype=bool)), None, SETTINGS)
    lonely = np.zeros(SHAPE, dtype=bool)
    lonely[::4, ::4] = True
    with pytest.raises(ObjectError, match="--mask"):
        surface.integrate(replace(truth_maps, mask=lonely), None, SETTINGS)


def test_pixels_without_a_normal_are_bridged() -> None:
    truth_maps, truth = sphere()
    normal, confidence = truth_maps.normal.copy(), truth_maps.confidence.copy()
    normal[50:54, 60:66] = np.nan
    normal[70:73, 60:66] = 0
    confidence[50:54, 60:66] = np.nan
    mesh = surface.integrate(replace(truth_maps, normal=normal, confidence=confidence), None, SETTINGS)
    assert error_share(mesh, truth, truth_maps.mask) < 0.02


@pytest.mark.skipif("POLCAP_DATA" not in os.environ, reason="needs $POLCAP_DATA/rendered")
@pytest.mark.parametrize(("name", "alone", "guided"), [("d21_spot", 0.02, 0.015), ("d23_penguin", 0.04, 0.03)])
def test_rendered_normals_give_the_rendered_depth(name: str, alone: float, guided: float) -> None:
    """Half resolution; the share is of the depth range, occlusions included; the prior is blurred over 8 px."""
    folder = Path(os.environ["POLCAP_DATA"]) / "rendered"
    stored, camera = np.load(folder / f"{name}.truth.npz"), json.loads((folder / f"{name}.meta.json").read_text())
    height, width = stored["mask"].shape

    def halved(values: Floats) -> Floats:
        return np.asarray(values.reshape(height // 2, 2, width // 2, 2, *values.shape[2:]).mean(axis=(1, 3)))

    mask = halved(stored["mask"].astype(np.float64)) == 1
    normal = halved(stored["normal"].astype(np.float64))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    truth = np.where(mask, halved(np.nan_to_num(stored["depth"].astype(np.float64))), 0)
    view = View(camera["fx"] / 2, (camera["cx"] / 2 - 0.5, camera["cy"] / 2 - 0.5), 2.0)
    scene = maps(normal, mask, view)
    assert error_share(surface.integrate(scene, None, SETTINGS), truth, mask) < alone
    blurred = ndimage.gaussian_filter(truth, 8) / np.maximum(ndimage.gaussian_filter(mask.astype(float), 8), 1e-3)
    radius = np.sqrt(mask.sum() / np.pi) / view.focal
    prior = (blurred / truth[mask].mean() - 1) / radius
    mesh = surface.integrate(replace(scene, depth_prior=prior.astype(np.float32)), None, SETTINGS)
    assert error_share(mesh, truth, mask) < guided


def waved(size: int, degrees: float) -> tuple[SurfaceMaps, Floats]:
    """A ball `size` px across whose normals err by `degrees` in waves of some px, as a network's do."""
    view = View(5.0 * size, (size / 2 - 0.5, size / 2 - 0.5), 1.0)
    ball, truth = sphere(view, (size, size), (0.0, 0.0, -1.0), 0.098)
    rng = np.random.default_rng(size)
    error = sum(ndimage.gaussian_filter(rng.normal(size=(size, size, 2)), (s, s, 0)) * s for s in (2, 8))
    error *= np.radians(degrees) / np.sqrt(np.mean(np.sum(error**2, axis=-1)))
    normal = ball.normal + np.concatenate([error, np.zeros((size, size, 1))], axis=-1)
    normal[..., 2] = np.maximum(normal[..., 2], 0.02)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return replace(ball, normal=np.where(ball.mask[..., None], normal, 0).astype(np.float32)), truth


@pytest.mark.parametrize("size", [200, 560])
def test_noise_tears_no_smooth_surface_at_any_resolution(size: int) -> None:
    scene, truth = waved(size, 6.0)
    mesh = surface.integrate(scene, None, SETTINGS)
    plain = surface.integrate(scene, None, surface.SurfaceSettings(stiffness=0.0))
    assert (mesh.pieces, mesh.cuts) == (1, 0.0)
    assert np.array_equal(mesh.depth, plain.depth, equal_nan=True)  # where nothing hides, plain least squares
    assert error_share(mesh, truth, scene.mask) < 0.02


@pytest.mark.parametrize(("step", "removed"), [(0.0, False), (30.0, True)])
def test_cut_that_strains_the_surface_is_removed(step: float, removed: bool) -> None:
    """A piece of a ball's flank, set back by some pixels though nothing hides it, comes back."""
    ball, _ = waved(200, 2.0)
    level = integration.PyramidLevel(normal_field(ball, np.radians(84), 0.0), SETTINGS.stiffness, SETTINGS.jump / 2)
    level.solve()
    plain = level.z
    row, column = (np.nonzero(ball.mask)[k] - 100 for k in (0, 1))
    level.choosing = np.ones(level.grid.size, dtype=bool)
    level.z = plain + step * ((column > 60) & (np.abs(row) < 40))
    assert level.occlusions().any() == removed
    level.remove_useless_cuts()
    assert level.choosing.any() != removed
    assert np.allclose(level.z, plain, atol=1e-6)


def test_cut_that_relieves_the_surface_stays() -> None:
    balls, _ = two_balls(0.12)
    level = integration.PyramidLevel(normal_field(balls, np.radians(84), 0.0), SETTINGS.stiffness, SETTINGS.jump / 2)
    level.cut_contours()
    level.integrate_bilaterally(SETTINGS.iterations, SETTINGS.tolerance)
    level.restore_contours()
    links = len(level.contours.link)
    level.solve()
    assert links and level.occlusions().any()
    level.remove_useless_cuts()
    assert level.choosing.all()
    assert len(level.contours.link) == links


def test_prior_weighs_alike_at_any_resolution() -> None:
    """A wrong prior, half as deep again, bends the ball's inner part by as much at 200 and at 400 px."""
    bend = []
    for size in (200, 400):
        view = View(5.0 * size, (size / 2 - 0.5, size / 2 - 0.5), 1.0)
        ball, truth = sphere(view, (size, size), (0.0, 0.0, -1.0), 0.098)
        radius = np.sqrt(ball.mask.sum() / np.pi) / view.focal
        wrong = 1.5 * (np.nan_to_num(truth) / np.nanmean(truth) - 1) / radius
        scene = replace(ball, depth_prior=wrong.astype(np.float32))
        depth = surface.integrate(scene, None, surface.SurfaceSettings(prior_weight=20.0, stiffness=0.0)).depth
        middle, side = (size // 2, size // 2), (size // 2, size // 8 * 7)
        bend.append(np.log(depth[side] / depth[middle]) / np.log(truth[side] / truth[middle]) - 1)
    assert bend[0] > 0.02
    assert bend[1] == pytest.approx(bend[0], rel=0.1)


def test_vertices_are_the_same_once_moved_from_their_middle_and_back() -> None:
    scene, _ = sphere()
    vertices = surface.integrate(scene, None, SETTINGS).vertices
    middle = (vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2
    assert np.array_equal(((vertices - middle).astype(np.float32) + middle).astype(np.float32), vertices)


def test_boundary_is_a_curve_not_stairs() -> None:
    """Distance of the rim's vertices from the ball's outline, in px of the picture: 1/√12 for pixels' stairs.

    Its depth: a stair of one pixel is ten deep where the surface leans by 84°.
    """
    ball, _ = sphere(View(1000.0, (99.5, 99.5), 1.0), (200, 200), (0.0, 0.0, -1.0), 0.09)
    mesh = surface.integrate(ball, None, SETTINGS)
    rim = np.unique(boundary_edges(mesh.faces))
    away = np.linalg.norm(mesh.uv[rim] * 200 - 100, axis=1)
    assert np.std(away) < 0.2
    follows = dict(boundary_edges(mesh.faces).tolist())
    depth = 1000 * mesh.vertices[:, 2].astype(np.float64)  # px
    bends = [depth[a] - 2 * depth[b] + depth[follows[b]] for a, b in follows.items()]
    assert np.sqrt(np.mean(np.square(bends))) < 0.3
    assert 0 < mesh.raggedness < 0.15


@pytest.mark.parametrize(("back", "holes"), [("open", True), ("skirt", True), ("closed", False)])
def test_back_closes_the_mesh_where_it_is_asked_to(back: str, holes: bool) -> None:
    truth_maps, _ = sphere()
    seen = surface.integrate(truth_maps, 0.95, SETTINGS)
    mesh = surface.integrate(truth_maps, 0.95, msgspec.structs.replace(SETTINGS, back=back))
    assert bool(len(boundary_edges(mesh.faces))) == holes
    assert (mesh.faces[: len(seen.faces)] == seen.faces).all()
    p, q, r = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    volume = np.sum(p * np.cross(q, r)) / 6
    if back == "closed":
        assert 0.0015 < volume < np.pi * 0.1**3  # the cap that is seen holds 0.0018, the cylinder about a half more


def two_balls(gap: float) -> tuple[SurfaceMaps, Floats]:
    """A small ball whose limb hides part of a large one, `gap` m behind it, and their depth [m]."""
    small, near = sphere(center=(0.04, 0.0, -1.0), radius=0.045)
    large, far = sphere(center=(-0.02, 0.0, -1.045 - gap - 0.09), radius=0.09)
    front = small.mask
    normal = np.where(front[..., None], small.normal, large.normal)
    return maps(normal, front | large.mask), np.where(front, near, far)


def test_part_behind_a_limb_stands_apart_where_no_slope_tells_by_how_much() -> None:
    scene, truth = two_balls(0.03)
    plain, ours = (surface.integrate(scene, None, surface.SurfaceSettings(stiffness=s)) for s in (0.0, 2.0))
    assert plain.cuts == 0 and ours.cuts > 0.3
    assert error_share(ours, truth, scene.mask) < 0.8 * error_share(plain, truth, scene.mask)


def test_crease_where_two_parts_touch_is_no_limb() -> None:
    a, _ = slopes()
    valley = 1 - 0.6 * np.abs(a)  # two planes that lean by 31° towards a crease
    scene = maps(from_depth(valley), np.ones(SHAPE, dtype=bool))
    mesh = surface.integrate(scene, None, SETTINGS)
    assert mesh.pieces == 1 and mesh.cuts == 0
