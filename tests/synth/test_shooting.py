"""Synthetic captures: files follow the physics, and truth.json states how they were made."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
from msgspec.structs import replace

from polcap.capture_values import Exif
from polcap.errors import CaptureError, SettingError
from polcap.formats import shipped_data
from polcap.formats.capture import focal_length
from polcap.optics import frames, projection
from polcap.optics.projection import transform_points
from polcap.synth import color_checker, render, shooting
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Cluster
from polcap.synth.forward_camera import Sensor
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot

GREY = Coat((Material((0.6, 0.6, 0.6), (0.6, 0.6, 0.6), "plain", roughness=(0.5, 0.5)),))
BALL = Scene(shape=Cluster(((0, 0, 0, 0.08),)), coat=GREY, position=(-0.08, 0.0, -0.7), light=(0.0, 0.0, 0.0))
STILL = Shoot(
    width=288, height=216, exposures=1, gain_jitter=0.0, nudge_px=0.0, nudge_deg=0.0, angle_error_deg=0.0,
    extinction_ratio=1e9, sensor=Sensor(full_well=1e8, read_noise=0.0),
)  # fmt: skip


def taken(folder: Path, scene: Scene, shoot: Shoot) -> tuple[list[np.ndarray], dict[str, Any], dict[str, np.ndarray]]:
    """Linear mosaics in order of their files, truth.json and truth.npz."""
    shooting.write(folder, scene, shoot)
    truth = json.loads((folder / "truth.json").read_text())
    pictures = []
    for file in truth["files"]:
        with rawpy.imread(str(folder / file["file"])) as raw:
            pictures.append((raw.raw_image_visible - 512.0) / (15871 - 512))
    with np.load(folder / "truth.npz") as maps:
        return pictures, truth, dict(maps)


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Any:
    shoot = replace(STILL, angles_deg=(0.0, 45.0, 90.0, 135.0), blur_px=0.0)
    return taken(tmp_path_factory.mktemp("still") / "capture", BALL, shoot)


def test_the_outline_of_a_ball_is_bright_through_a_polarizer_along_its_azimuth(still: Any) -> None:
    """Diffuse light is polarized along the projected normal: at 0° the right edge is bright, at 90° the upper edge."""
    pictures, _, maps = still
    i0, i45, i90, i135 = (p[0::2, 1::2] for p in pictures)  # one of the greens
    n = maps["normal"][0::2, 1::2].astype(float)
    edge = (n[..., 2] < 0.4) & (n[..., 2] > 0.2)
    azimuth = np.degrees(np.arctan2(n[..., 1], n[..., 0]))
    for angle, passed, blocked in ((0, i0, i90), (45, i45, i135), (90, i90, i0), (135, i135, i45)):
        here = edge & (np.abs(azimuth - angle) < 10)
        assert here.sum() > 5
        assert (passed / blocked)[here].min() > 1.1


def test_files_hold_the_stokes_parameters_of_the_truth(still: Any) -> None:
    """In the middle of the picture the ray's frame is that of the picture; the ball reaches 9° off axis."""
    pictures, truth, maps = still
    i0, i45, i90, i135 = (p[0::2, 1::2] for p in pictures)
    s0, s1, s2 = i0 + i90, i0 - i90, i45 - i135
    np.testing.assert_allclose(i45 + i135, s0, rtol=2e-3, atol=1e-3)  # off axis 45° and 135° are not perpendicular
    green = np.array(truth["camera_matrix_from_linear_srgb"])[1]
    t0, t1, t2 = (maps["S"].astype(float) @ green)[:, 0::2, 1::2]
    inside = maps["mask"][0::2, 1::2] & (maps["normal"][0::2, 1::2, 2] > 0.3)
    scale = np.median((s0 / np.where(t0, t0, 1))[inside])
    np.testing.assert_allclose(s0[inside], scale * t0[inside], rtol=3e-3, atol=3e-4)
    assert np.abs(s1 - scale * t1)[inside].max() < 0.02 * s0[inside].max() * 0.1  # 2 % of a DoLP of 0.1
    assert np.abs(s2 - scale * t2)[inside].max() < 0.04 * s0[inside].max() * 0.1  # frames differ by up to 1°


def test_white_patch_has_its_reflectance(still: Any) -> None:
    pictures, truth, _ = still
    quads = np.array(truth["chart"]["patch_corners_px"])
    reference = shipped_data.colorchecker().rec709 @ np.array(truth["camera_matrix_from_linear_srgb"])[1]
    s0 = pictures[0] + pictures[2]
    scale = truth["files"][0]["relative_exposure"] * truth["white_S0"]
    far = np.linalg.norm(color_checker.patches(Chart()).mean(axis=1), axis=-1)  # of the patches from the flash
    for patch in (18, 20, 22, 7):
        (x0, y0), (x1, y1) = quads[patch].min(axis=0) + 2, quads[patch].max(axis=0) - 2
        part = s0[int(np.ceil(y0)) : int(y1), int(np.ceil(x0)) : int(x1)]
        rows, columns = np.indices(part.shape)
        green = part[(rows + int(np.ceil(y0)) + columns + int(np.ceil(x0))) % 2 == 1]
        expected = reference[patch] * (far[18] / far[patch]) ** 3  # cos θ / r²
        assert green.mean() / scale == pytest.approx(expected, rel=0.003)


def test_ball_is_where_the_projection_puts_it(still: Any) -> None:
    _, truth, maps = still
    middle, radius, f = np.array(BALL.position), 0.08, truth["focal_px"]
    y, x = np.mgrid[:216, :288]
    cx, cy = truth["principal_px"]
    v = frames.unit(np.stack([(cx - x) / f, (y - cy) / f, np.ones(x.shape)], axis=-1))
    b = -(v @ middle)
    root = b**2 - middle @ middle + radius**2
    np.testing.assert_array_equal(maps["mask"], root > 0)
    distance = b - np.sqrt(np.where(root > 0, root, 0))
    safe = root > 1e-5  # at the outline a micrometre is a pixel
    np.testing.assert_allclose(maps["depth"][safe], (distance * v[..., 2])[safe], atol=1e-5)
    normal = (-v * distance[..., None] - middle) / radius
    np.testing.assert_allclose(maps["normal"][safe], normal[safe], atol=2e-3)  # half precision


def centroid(picture: np.ndarray, quad: np.ndarray) -> np.ndarray:
    """Centroid (x, y) of the brightness around a patch, minus its dark surroundings."""
    binned = picture.reshape(picture.shape[0] // 2, 2, picture.shape[1] // 2, 2).mean(axis=(1, 3))
    (x0, y0), (x1, y1) = (quad.min(axis=0) / 2 - 1).round().astype(int), (quad.max(axis=0) / 2 + 1).round().astype(int)
    part = binned[y0 : y1 + 1, x0 : x1 + 1]
    weight = np.clip(part - 0.05 * part.max(), 0, None)
    rows, columns = np.indices(part.shape)
    at = np.array([(weight * (columns + x0)).sum(), (weight * (rows + y0)).sum()]) / weight.sum()
    return np.asarray(2 * at + 0.5)


def test_transform_maps_the_chart_to_its_place_in_a_shot(tmp_path: Path) -> None:
    scene = Scene(BALL.shape, GREY, position=(-0.09, 0, -0.7), chart=Chart(center=(0.1, 0.02, -0.69), pitch=0.024))
    pictures, truth, _ = taken(
        tmp_path / "c", scene, replace(STILL, width=576, height=432, nudge_px=12.0, nudge_deg=1.0, seed=6)
    )
    quads = np.array(truth["chart"]["patch_corners_px"])[[18, 19, 20, 15, 5, 10]]
    matrices = [np.array(file["transform"]) for file in truth["files"]]
    found = [
        np.array([centroid(picture, transform_points(matrix, quad)) for quad in quads])
        for picture, matrix in zip(pictures, matrices)
    ]
    for matrix, here in zip(matrices[1:], found[1:]):
        assert np.linalg.norm(here - found[0], axis=-1).min() > 1  # px: there is something to find
        off = here - transform_points(matrix, found[0])
        np.testing.assert_allclose(off.mean(axis=0), 0, atol=0.07)  # px: one centroid is good to 0.15


def test_positive_roll_turns_the_picture_counter_clockwise_and_shift_is_right_and_down() -> None:
    matrix = shooting.transform(STILL, (3.0, 2.0), 10.0)
    cx, cy = STILL.view.center
    right_of_centre = matrix @ [cx + 100, cy, 1]
    assert right_of_centre[1] < cy  # went up
    np.testing.assert_allclose(matrix @ [cx, cy, 1], [cx + 3, cy + 2, 1])


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    shoot = Shoot(width=96, height=72, samples=1, exposures=2)
    for name in ("a", "b"):
        shooting.write(tmp_path / name, random_scene(3, "clusters"), shoot)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 3 * 2 + 2
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("bracket", ["time", "aperture", "iso", "flash"])
def test_every_kind_of_bracket_steps_by_four(tmp_path: Path, bracket: str) -> None:
    shoot = replace(STILL, width=96, height=72, samples=1, exposures=3, angles_deg=(0.0,), bracket=bracket)
    pictures, truth, maps = taken(tmp_path / "c", BALL, shoot)
    dim = maps["mask"] & (pictures[2] < 0.9)
    assert dim.sum() > 50
    for darker, lighter in pairwise(pictures):
        assert (lighter / darker)[dim].mean() == pytest.approx(4, rel=0.01)
    settings = {(f["time"], f["fnumber"], f["iso"]) for f in truth["files"]}
    assert len(settings) == (1 if bracket == "flash" else 3)  # a flash's power is not in the EXIF


@pytest.mark.parametrize("kind", ["bumps", "clusters", "vase"])
def test_object_and_chart_are_complete_and_separate_in_every_scene(kind: Any) -> None:
    shoot = Shoot(width=144, height=108)
    for seed in range(20):
        scene = random_scene(seed, kind)
        mask = render.gbuffer(scene, shoot.view, shoot.height, shoot.width).mask
        assert scene.chart is not None
        corners = projection.project(shoot.view, color_checker.corners(scene.chart))
        assert 0.03 < mask.mean() < 0.3
        assert not mask[[0, -1]].any() and not mask[:, [0, -1]].any()
        assert corners.min() > 2 and (corners < [shoot.width - 3, shoot.height - 3]).all()
        assert np.flatnonzero(mask.any(axis=0)).max() + 2 < corners[:, 0].min(), seed


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("mine")
    with pytest.raises(CaptureError, match="not an empty folder"):
        shooting.write(tmp_path, BALL, STILL)
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]
    with pytest.raises(SettingError, match="bumps, clusters, vase"):
        random_scene(0, "teapot")  # type: ignore[arg-type]


def test_a_camera_that_rolls_turns_its_polarizer_with_it() -> None:
    """A ball on the axis under a flash at the lens has the same picture at every roll of the camera."""
    scene = Scene(shape=BALL.shape, coat=GREY, position=(0.0, 0.0, -0.7), light=(0.0, 0.0, 0.0), chart=None)
    studio = shooting.Studio(scene, replace(STILL, width=96, height=72, samples=1, blur_px=0.0))
    upright, other = studio.through(30.0), studio.through(70.0)
    found = studio.radiance(shooting.ShotPose(30.0, rot_deg=20.0))
    inside = studio.buffer.mask & (studio.buffer.normal[..., 2] > 0.35)
    assert np.abs(found - upright)[inside].max() < 0.02 * np.abs(other - upright)[inside].max()


@pytest.mark.parametrize("size", [(1152, 768), (640, 480), (400, 600)])
def test_the_full_frame_equivalent_has_the_cameras_diagonal(size: tuple[int, int]) -> None:
    shoot = Shoot(width=size[0], height=size[1])
    exif = shooting._exposure(shoot, shooting.Take(0, 0, 1.0), 1.0)[0]
    stated = Exif(focal_length_35mm=exif.focal_length_35mm, width=size[0], height=size[1])
    assert focal_length.find(stated, None, None).px == pytest.approx(shoot.view.focal)
