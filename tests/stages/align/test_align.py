"""Registration of polarizer shots against poses the scene was evaluated at."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from polcap.errors import AlignmentError
from polcap.optics import registration
from polcap.optics.projection import transform_points
from polcap.stages import align
from polcap.stages.align import object_motion
from polcap.stages.align.detail import detail
from tests import scenes


def pose(dx: float, dy: float, degrees: float) -> np.ndarray:
    """Reference px → shot px of a camera nudged about the picture's centre."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    to_center = np.array([[1, 0, -scenes.WIDTH / 2], [0, 1, -scenes.HEIGHT / 2], [0, 0, 1.0]])
    return np.linalg.inv(to_center) @ np.array([[c, -s, dx], [s, c, dy], [0, 0, 1.0]]) @ to_center


def register(radiance, **settings):
    return align.register(radiance, align.AlignSettings(**settings))


def errors_px(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distance between two transforms over the ball, px."""
    rows, columns = np.nonzero(scenes.ball_object().mask)
    at = np.stack([columns, rows, np.ones(len(rows))])
    a, b = found @ at, true @ at
    return np.hypot(*(a[:2] / a[2] - b[:2] / b[2]))


@pytest.mark.parametrize("seed", range(3))
def test_polarized_textured_shots_are_registered_to_a_twentieth_of_a_pixel(seed):
    rng = np.random.default_rng(seed)
    true = [np.eye(3)] + [pose(rng.uniform(-20, 20), rng.uniform(-20, 20), rng.uniform(-0.5, 0.5)) for _ in range(2)]
    radiance = scenes.stack(true, noise=0.004, seed=seed)
    found = register(radiance)
    error = np.concatenate([errors_px(found.transform[k], true[k]) for k in (1, 2)])
    assert np.median(error) < 0.05
    assert error.max() < 0.15


def test_hot_pixels_do_not_hold_the_shots_in_place():
    """Two thousandths of the pixels are bright at the same places of every shot."""
    true, rng = [np.eye(3), pose(5, 0, 0), pose(0, -5, 0)], np.random.default_rng(0)
    radiance = scenes.stack(true, noise=0.004)
    hot = np.where(rng.random((240, 320, 1)) < 0.002, rng.uniform(0.1, 1, (240, 320, 1)), 0).astype(np.float32)
    radiance = replace(radiance, value=radiance.value + hot)
    found = register(radiance)
    assert max(errors_px(found.transform[k], true[k]).max() for k in (1, 2)) < 0.1


def test_a_shift_of_a_quarter_pixel_is_not_pulled_to_a_whole_one():
    true = [np.eye(3), pose(0.25, -0.25, 0), pose(-0.25, 0.25, 0)]
    found = register(scenes.stack(true, noise=0.002))
    for k in (1, 2):
        assert errors_px(found.transform[k], true[k]).max() < 0.03


def test_error_far_from_all_detail_is_that_of_its_scatter():
    """Texture in one corner: roll and zoom left open by noise count with the distance."""
    y, x = np.mgrid[:240, :320]
    texture = gaussian_filter(np.random.default_rng(5).normal(size=(240, 320)), 1.5)
    light = np.where((y > 140) & (x > 180), 0.3 + texture, 0.3).astype(np.float32)
    blank = replace(scenes.stack(), variance=np.full((3, 240, 320, 3), 1e-6, np.float32))
    near, far = np.array([250.0, 190]), np.array([30.0, 30])
    off, stated = [], []
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(scale=0.03, size=(3, 240, 320, 3))
        value = np.asarray(light[..., None] + noise, np.float32)
        taken = replace(blank, value=value, quality=np.zeros((3, 240, 320), np.uint8))
        a, b = (detail(taken.shot(k), 4.0, 1) for k in (0, 1))
        found = registration.register(a, b, "similarity")
        off.append([np.hypot(*(transform_points(found.matrix, at) - at)) / np.sqrt(2) for at in (near, far)])
        stated.append([found.sigma_at(at) for at in (near, far)])
    scatter, sigma = np.sqrt(np.mean(np.square(off), axis=0)), np.mean(stated, axis=0)
    assert sigma[1] > 2 * sigma[0]
    assert scatter[1] < 2 * sigma[1] and sigma[1] < 4 * scatter[1]


def test_flash_energy_does_not_move_a_shot():
    radiance = scenes.stack(gain=np.array([1.0, 0.9, 1.1]), noise=0.002)
    found = register(radiance)
    assert errors_px(found.transform[2], np.eye(3)).max() < 0.03


def test_another_scene_is_refused_by_name():
    radiance = scenes.stack(noise=0.002)
    value = radiance.value.copy()
    value[1] = np.random.default_rng(0).uniform(0, 0.5, value[1].shape)
    with pytest.raises(AlignmentError, match="shot 45° shows another scene"):
        register(replace(radiance, value=value))


def test_a_shot_that_moved_too_far_is_refused_by_name_and_limit():
    radiance = scenes.stack([np.eye(3), np.eye(3), pose(12, 0, 0)], noise=0.002)
    with pytest.raises(AlignmentError, match=r"shot 90° moved by 1\d\.\d px, more than align.max_shift_px = 5"):
        register(radiance, max_shift_px=5)


def test_shots_of_a_locked_camera_are_not_registered():
    found = register(scenes.stack(noise=0.01), model="none")
    assert np.array_equal(found.transform, np.tile(np.eye(3), (3, 1, 1)))


def test_strong_polarization_is_no_other_scene() -> None:
    """A film that turns the polarization from patch to patch, under one polarizer: contrast changes, edges stay."""
    random = np.random.default_rng(3)
    patches = np.kron(random.uniform(0, np.pi, (20, 26)), np.ones((12, 12)))[: scenes.HEIGHT, : scenes.WIDTH]
    patches = np.pad(patches, ((0, 0), (0, scenes.WIDTH - patches.shape[1])), mode="edge")
    radiance = scenes.stack(noise=0.002)
    wave = 1 + 0.4 * np.cos(2 * (radiance.angle[:, None, None] - patches))
    y, x = np.mgrid[: scenes.HEIGHT, : scenes.WIDTH].astype(float)
    value = scenes.texture(x, y) * wave[..., None]
    value = value.astype(np.float32)
    found = register(replace(radiance, value=value))
    assert np.abs(found.transform - np.eye(3))[:, :2, 2].max() < 0.5
    other = np.stack([value[0], value[1][::-1], value[2][:, ::-1]])
    with pytest.raises(AlignmentError, match="another scene"):
        register(replace(radiance, value=other), max_shift_px=500)


def test_shots_with_nothing_to_compare_are_named() -> None:
    radiance = scenes.stack()
    even = np.full_like(radiance.value, 0.2)
    for fields, words in (
        ({"quality": np.full_like(radiance.quality, 1)}, "100% of it is over-exposed; shoot with less light"),
        ({"value": even, "variance": np.full_like(even, 1e-6)}, "even all over; put something with texture"),
        ({"value": 0 * even, "variance": np.full_like(even, 1e-6)}, "it is too dark; use more light"),
    ):
        with pytest.raises(AlignmentError, match=f"no unclipped detail in common with the first shot: {words}"):
            register(replace(radiance, **fields))


def test_an_object_that_moved_before_a_still_backdrop_is_distinguished_from_a_moved_camera():
    """A ball 3 px further in one shot, and a texture around it that stayed; or both moved, with a roll."""
    ball = scenes.ball_object()
    for true, expected in (([np.eye(3), pose(3, 0, 0), np.eye(3)], 3.0), ([np.eye(3)] * 3, 0.0)):
        stack = scenes.before_backdrop(true)
        found = register(stack)
        assert object_motion.measure(stack, found, ball).length[1] == pytest.approx(expected, abs=0.5)
    radiance = scenes.stack(noise=0.002)
    assert np.nanmax(object_motion.measure(radiance, scenes.still(3), ball).length) < 0.5


@pytest.mark.parametrize("tiles", [4, 6, 20])
def test_three_times_the_error_of_few_tiles_is_as_rare_as_three_sigma(tiles: int) -> None:
    """Normal errors over the scatter of so many tiles, of which each measures two of four parameters."""
    random, freedom = np.random.default_rng(tiles), 2 * tiles - 4
    ratio = random.normal(size=400_000) / np.sqrt(random.chisquare(freedom, 400_000) / freedom)
    beyond = (np.abs(ratio) > 3 * object_motion._student(tiles)).mean()
    assert beyond == pytest.approx(0.0027, rel=0.15)
