"""The outline of a ball shows which shot's angle is wrong, and that a lamp shone from the side."""

from typing import Any

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.optics import mueller
from polcap.quality import rim
from tests import scenes

Y, X = np.mgrid[0 : scenes.HEIGHT, 0 : scenes.WIDTH].astype(float)
STOKES, BALL = scenes.stokes(X, Y)


def ball_rim(actual_deg: tuple[float, ...], lamp: float = 0.0) -> rim.Rim:
    shots = np.einsum("kj,jhw->khw", mueller.analyzer(np.radians(actual_deg)), STOKES.sum(-1))
    shots *= 1 + 0.004 * np.random.default_rng(0).normal(size=shots.shape)
    shots[1] *= 1 + lamp * scenes.normals(X, Y)[0][..., 0]
    return rim.sample(shots, BALL, np.ones_like(BALL))


@pytest.mark.parametrize("shot", [0, 1, 2])
def test_wrong_angle_of_one_shot_is_found(shot: int) -> None:
    actual = [0.0, 45.0, 90.0]
    actual[shot] += 15
    found = rim.fit_angle_error(ball_rim(tuple(actual)), scenes.ANGLES, np.radians(8))
    assert found.shot == shot
    assert np.degrees(found.angle) == pytest.approx(15, abs=rim._STEP_DEG)
    assert found.misfit < 0.5 and 2.5 < found.sigmas < np.inf


def test_a_zero_error_of_the_ring_is_shared_by_all_shots() -> None:
    found = rim.fit_angle_error(ball_rim((-12, 33, 78)), scenes.ANGLES, np.radians(8))
    assert found.shot is None
    assert np.degrees(found.angle) == pytest.approx(-12, abs=rim._STEP_DEG)


def test_random_errors_of_the_outline_give_no_significant_angle_error() -> None:
    """The best of a hundred angle errors always fits better than none, because it is the best."""
    angle = np.radians([62.0, 134.0, 165.0])
    fooled, sure = 0, 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        azimuth, sector = np.linspace(-np.pi, np.pi, 480, endpoint=False), np.repeat(np.arange(24), 20)
        bent = azimuth + np.repeat(random.normal(0, np.radians(20), 24), 20)  # contour beside the surface's azimuth
        light = 1 + 0.1 * np.cos(2 * (angle[:, None] - bent))
        found = rim.fit_angle_error(rim.Rim(light, azimuth, sector, np.ones(480)), angle, np.radians(8))
        fooled += found.shot is not None and found.misfit < 0.9
        sure += found.shot is not None and found.sigmas > 2.5
    assert fooled > 5 and sure < 3


def test_no_angle_error_fits_better_than_true_angles() -> None:
    assert rim.fit_angle_error(ball_rim((0.5, 44.6, 90.3)), scenes.ANGLES, np.radians(8)).misfit > 0.9


def test_a_lamp_at_the_side_is_distinguished_from_polarization() -> None:
    assert rim.side_light(ball_rim((0, 45, 90)), scenes.ANGLES).max() < 0.02
    side = rim.side_light(ball_rim((0, 45, 90), lamp=0.15), scenes.ANGLES)
    assert int(np.argmax(side)) == 1
    assert side[1] == pytest.approx(0.15 * 2 / 3, abs=0.03)  # against the mean of all three


def _rim_of(light: Floats, azimuth: Floats) -> rim.Rim:
    return rim.Rim(light / light.mean(axis=0), azimuth, np.zeros(azimuth.size, int), np.ones(azimuth.size))


@pytest.mark.parametrize("degrees", [(0, 45, 90), (0, 60, 120), (0, 45, 90, 135)])
def test_a_lamp_from_any_side_is_found_and_a_box_with_one_polarized_side_is_not_a_lamp(degrees: Any) -> None:
    angle, azimuth = np.radians(degrees), np.linspace(-np.pi, np.pi, 360, endpoint=False)
    wave = np.cos(2 * (angle[:, None] - azimuth))
    box = 1 + np.where(np.abs(azimuth - 0.6) < 0.8, 0.13, 0.02) * wave
    uneven = np.abs(np.exp(1j * azimuth) @ (box / box.mean(axis=0)).T) / 180
    assert uneven.max() > 0.02 and rim.side_light(_rim_of(box, azimuth), angle).max() < 0.01
    for shot in range(len(angle)):
        for side in np.radians(np.arange(0, 360, 15)):
            ball = 1 + 0.1 * wave
            ball[shot] += 0.15 * np.maximum(np.cos(azimuth - side), 0)
            found = rim.side_light(_rim_of(ball, azimuth), angle)
            assert int(np.argmax(found)) == shot and found[shot] == pytest.approx(0.05, rel=0.25)


def test_diffuse_polarization_grows_towards_the_outline() -> None:
    dolp = rim.summarize(ball_rim((0, 45, 90)), scenes.ANGLES).dolp
    assert 0.05 < dolp < 0.4  # Fresnel, n = 1.5: 3 % at 40°, 39 % at 90°
