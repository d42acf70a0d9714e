"""Integrable normals: those of a surface do not change, others come nearer to one surface; depth steps stay."""

import numpy as np
import pytest

from polcap.image_values import Bools, Floats, View
from polcap.optics import frames
from polcap.stages.infer.shape import integrable_normals

SIZE = 120
RAYS = frames.rays(View(150.0, (80.0, 30.0), 1.0), SIZE, SIZE)  # up to 36° from the axis
EVERYWHERE = np.ones((SIZE, SIZE), bool)
CENTER, RADIUS = np.array([0.1, -0.2, -5.0]), 1.2


def ball() -> tuple[Floats, Bools]:
    """Normals (H, W, 3) of a ball in perspective, and its mask without the outermost rim."""
    along = frames.dot(RAYS, CENTER)
    inside = along**2 - CENTER @ CENTER + RADIUS**2
    point = RAYS * (along + np.sqrt(np.maximum(inside, 0)))[..., None]
    normal = frames.unit(point - CENTER)
    return normal, (inside > 0) & (frames.dot(normal, RAYS) > 0.3)


def integrable(normal: Floats, mask: Bools = EVERYWHERE, expected_deg: float = 5.0) -> Floats:
    error = np.full(mask.shape, expected_deg, np.float32)
    return integrable_normals.make_integrable(normal.astype(np.float32), error, mask, RAYS)


def leaning(normal: Floats, zenith_deg: Floats, azimuth_deg: Floats) -> Floats:
    """Turn normals by errors of zenith angle and azimuth (H, W) in the frames of their rays."""
    local = frames.to_ray_frame(normal, RAYS)
    zenith = np.arccos(np.clip(local[..., 2], -1, 1)) + np.radians(zenith_deg)
    azimuth = np.arctan2(local[..., 1], local[..., 0]) + np.radians(azimuth_deg)
    turned = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)
    return np.asarray(frames.from_ray_frame(turned, RAYS))


def error(found: Floats, true: Floats, where: Bools = EVERYWHERE) -> float:
    return float(frames.angle_deg(found, true)[where].mean())


def test_normals_of_a_ball_in_perspective_do_not_change() -> None:
    true, mask = ball()
    assert mask.sum() > 1500
    assert error(integrable(true, mask), true, mask) < 0.1


def test_errors_of_the_zenith_angle_that_no_surface_has_become_smaller() -> None:
    """Waves of 6° along the ball's level lines."""
    true, mask = ball()
    local = frames.to_ray_frame(true, RAYS)
    wrong = leaning(true, 6 * np.sin(5 * np.arctan2(local[..., 1], local[..., 0])), 0 * RAYS[..., 0])
    assert error(integrable(wrong, mask), true, mask) < 0.6 * error(wrong, true, mask)


def test_the_zenith_angle_yields_to_the_azimuth() -> None:
    """Errors of zenith angle leave more traces of their own than errors of azimuth of the same arc."""
    true, mask = ball()
    local = frames.to_ray_frame(true, RAYS)
    angle = np.arctan2(local[..., 1], local[..., 0])
    along, across = leaning(true, 6 * np.sin(5 * angle), 0 * angle), leaning(true, 0 * angle, 6 * np.sin(5 * angle))
    changes = [error(integrable(wrong, mask), wrong, mask) for wrong in (along, across)]
    assert changes[0] > changes[1]


def test_a_depth_step_keeps_its_normals() -> None:
    """Half of a tilted plane lies behind the other: along the step, their slopes belong to no common surface."""
    tilt = np.where(np.arange(SIZE) < 60, 0.6, -0.6)[:, None] * np.ones(SIZE)
    true = frames.unit(np.stack([tilt, np.full_like(tilt, 0.2), np.ones_like(tilt)], axis=-1))
    away = abs(np.arange(SIZE) - 59.5)[:, None] * np.ones(SIZE) > 15
    assert error(integrable(true), true, away) < 0.5


def test_fine_relief_stays() -> None:
    normal = np.repeat(np.repeat(ball()[0], 4, axis=0), 4, axis=1)[:480, :480]
    rays = frames.rays(View(600.0, (321.5, 121.5), 1.0), 480, 480)
    mask = np.repeat(np.repeat(ball()[1], 4, axis=0), 4, axis=1)
    relief = frames.unit(normal + 0.1 * np.sin(np.arange(480) * 2.0)[:, None, None] * [0, 1, 0])
    found = integrable_normals.make_integrable(relief, np.full(mask.shape, 5, np.float32), mask, rays)
    assert error(found, relief, mask) < 0.5


def test_an_object_of_few_pixels_or_none_passes() -> None:
    few = np.zeros((SIZE, SIZE), bool)
    assert not integrable(ball()[0], few).any()
    few[60:62, 60] = True
    assert np.isfinite(integrable(ball()[0], few)).all()


def test_separate_parts_have_finite_normals() -> None:
    """The distance of each part is free, and the corners of a single cell are too."""
    true, _ = ball()
    mask = np.zeros_like(EVERYWHERE)
    mask[10:19, 10:19] = True
    mask[30:60:2, 30:60:2] = True
    found = integrable(np.where(np.isfinite(true), true, [0.0, 0.0, 1.0]), mask, 0.01)
    assert np.isfinite(found).all() and np.allclose(np.linalg.norm(found[mask], axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("expected_deg", [0.0, 90.0])
def test_any_stated_error_gives_normals(expected_deg: float) -> None:
    true, mask = ball()
    assert error(integrable(true, mask, expected_deg), true, mask) < 0.1
