"""Integration: depth from normals, with cuts where one part hides another."""

import json
import os
from dataclasses import replace
from pathlib import Path

import bench_scans
import numpy as np
import pytest
from scipy import ndimage

from polcap.errors import ObjectError
from polcap.image_values import Floats, View
from polcap.stages import surface
from polcap.stages.surface import integration
from polcap.stages.surface.pyramid_level import PyramidLevel
from polcap.stages.surface.slope_equations import normal_field
from tests.stages.surface.depth_scenes import (
    SHAPE,
    VIEW,
    ball_in_a_ramp,
    error_share,
    from_depth,
    maps,
    slopes,
    sphere,
    two_balls,
    waved,
)  # fmt: skip

SETTINGS = surface.SurfaceSettings()


@pytest.mark.parametrize("decision_pixels", [80_000, 500])
def test_sphere_in_perspective_at_any_depth_of_the_pyramid(
    decision_pixels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(integration, "_DECISION_PIXELS", decision_pixels)
    truth_maps, truth = sphere()
    mesh = surface.integrate(truth_maps, 0.95, SETTINGS)
    assert error_share(mesh, truth, truth_maps.mask) < 0.01  # the outermost pixels are infinitely steep
    assert np.isnan(mesh.depth[~truth_maps.mask]).all()


def test_bumps_are_recovered_to_a_thousandth() -> None:
    a, b = slopes()
    truth = 1 + 0.01 * np.sin(40 * a) * np.cos(35 * b) + 0.1 * a
    mask = (a / 0.14) ** 2 + (b / 0.12) ** 2 < 1
    mesh = surface.integrate(maps(from_depth(truth), mask), None, SETTINGS)
    assert error_share(mesh, truth, mask) < 0.001


def test_occlusion_is_a_depth_step_and_a_cut() -> None:
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


def test_prior_sets_the_offset_of_separate_parts() -> None:
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


def test_empty_object_is_refused() -> None:
    nothing, lonely = np.zeros((2, *SHAPE), dtype=bool)
    lonely[::4, ::4] = True
    for mask in (nothing, lonely):
        with pytest.raises(ObjectError, match="--mask"):
            surface.integrate(replace(sphere()[0], mask=mask), None, SETTINGS)


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


@pytest.mark.parametrize("size", [200, 560])
def test_noise_does_not_cut_a_smooth_surface(size: int) -> None:
    scene, truth = waved(size, 6.0)
    mesh = surface.integrate(scene, None, SETTINGS)
    assert (mesh.pieces, mesh.cuts) == (1, 0.0)
    if size == 200:  # where nothing hides, plain least squares
        plain = surface.integrate(scene, None, surface.SurfaceSettings(stiffness=0.0))
        assert np.array_equal(mesh.depth, plain.depth, equal_nan=True)
    assert error_share(mesh, truth, scene.mask) < 0.02


@pytest.mark.parametrize(("step", "removed"), [(0.0, False), (30.0, True)])
def test_cut_that_strains_the_surface_is_removed(step: float, removed: bool) -> None:
    """A piece of a ball's flank, set back by some pixels though nothing hides it, comes back."""
    ball, _ = waved(200, 2.0)
    level = PyramidLevel(normal_field(ball, np.radians(84), 0.0), SETTINGS.stiffness, SETTINGS.jump / 2)
    level.solve()
    plain = level.z
    row, column = (np.nonzero(ball.mask)[k] - 100 for k in (0, 1))
    level.choosing = np.ones(level.grid.size, dtype=bool)
    level.z = plain + step * ((column > 60) & (np.abs(row) < 40))
    assert level.occlusions().any() == removed
    integration.remove_useless_cuts(level)
    assert level.choosing.any() != removed
    assert np.allclose(level.z, plain, atol=1e-6)


def test_cut_that_relieves_the_surface_remains() -> None:
    balls, _ = two_balls(0.12)
    level = PyramidLevel(normal_field(balls, np.radians(84), 0.0), SETTINGS.stiffness, SETTINGS.jump / 2)
    integration.cut_contours(level)
    level.integrate_bilaterally(SETTINGS.iterations, SETTINGS.tolerance)
    integration.restore_contours(level)
    links = len(level.contours.link)
    level.solve()
    assert links and level.occlusions().any()
    integration.remove_useless_cuts(level)
    assert level.choosing.all()
    assert len(level.contours.link) == links


def test_prior_has_the_same_weight_at_any_resolution() -> None:
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


def test_part_behind_an_occluding_contour_is_separated() -> None:
    scene, truth = two_balls(0.03)
    plain, ours = (surface.integrate(scene, None, surface.SurfaceSettings(stiffness=s)) for s in (0.0, 2.0))
    assert plain.cuts == 0 and ours.cuts > 0.3
    assert error_share(ours, truth, scene.mask) < 0.8 * error_share(plain, truth, scene.mask)


@pytest.mark.skipif("POLCAP_DATA" not in os.environ, reason="needs $POLCAP_DATA/real")
@pytest.mark.parametrize(("name", "least_squares", "ours"), [("bear", 0.8, 0.2), ("reading", 4.0, 0.24)])
def test_scanned_normals_give_the_scanned_depth(name: str, least_squares: float, ours: float) -> None:
    """Mean depth error [mm]; the limit of the second is under that of bilateral integration, 0.36 or 0.24 mm."""
    scene, truth = bench_scans.scan(Path(os.environ["POLCAP_DATA"]) / "real/scanned_normals" / name)
    plain, cut = (surface.integrate(scene, None, surface.SurfaceSettings(stiffness=s)).depth for s in (0.0, 2.0))
    assert bench_scans.mean_error(plain, truth) > least_squares
    assert bench_scans.mean_error(cut, truth) < ours


def test_crease_between_touching_parts_is_not_cut() -> None:
    a, _ = slopes()
    valley = 1 - 0.6 * np.abs(a)  # two planes that lean by 31° towards a crease
    scene = maps(from_depth(valley), np.ones(SHAPE, dtype=bool))
    mesh = surface.integrate(scene, None, SETTINGS)
    assert mesh.pieces == 1 and mesh.cuts == 0
