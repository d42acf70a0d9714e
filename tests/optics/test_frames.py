"""Frames on view rays: geometry that can be drawn on paper."""

import numpy as np
import pytest

from polcap.image_values import View
from polcap.optics import frames

VIEW = View(focal=100.0, center=(20.0, 10.0), scale=1.0)


def some_rays() -> np.ndarray:
    return frames.rays(VIEW, 30, 50).astype(np.float64)


def test_rays_point_from_the_surface_to_the_lens() -> None:
    v = frames.rays(VIEW, 30, 50)
    np.testing.assert_allclose(v[10, 20], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(v[10, 45], np.array([-25, 0, 100]) / np.hypot(25, 100), rtol=1e-5)  # right of centre
    assert v[0, 20, 1] < 0 < v[29, 20, 1]  # a surface above the centre looks down at the lens


def test_basis_is_right_handed_and_upright() -> None:
    v = some_rays()
    e_x, e_y = frames.basis(v)
    frame = np.stack([e_x, e_y, v], axis=-1)
    np.testing.assert_allclose(np.swapaxes(frame, -1, -2) @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=1e-6)
    assert (e_x[..., 0] > 0.9).all() and (e_y[..., 1] > 0.9).all()


def test_ray_frame_and_back() -> None:
    v = some_rays()
    n = np.random.default_rng(0).normal(size=v.shape)
    np.testing.assert_allclose(frames.from_ray_frame(frames.to_ray_frame(n, v), v), n, atol=1e-6)
    np.testing.assert_allclose(frames.to_ray_frame(v, v), np.broadcast_to([0, 0, 1], v.shape), atol=1e-6)


def test_polarizer_axis_is_the_vector_left_when_its_part_along_the_ray_is_taken_out() -> None:
    v = some_rays()
    for angle in np.radians([0, 30, 45, 90, 135]):
        on_ray = frames.axis_on_ray(np.array(angle), v)
        a = np.array([np.cos(angle), np.sin(angle), 0])
        left = a - (v @ a)[..., None] * v
        e_x, e_y = frames.basis(v)
        seen = np.cos(on_ray)[..., None] * e_x + np.sin(on_ray)[..., None] * e_y
        np.testing.assert_allclose(seen, left / np.linalg.norm(left, axis=-1, keepdims=True), atol=1e-6)


def test_axes_keep_their_angle_in_the_middle_and_horizontal_stays_horizontal() -> None:
    v = some_rays()
    for angle in np.radians([0, 30, 135]):
        turned = frames.axis_on_ray(np.array(angle), v)[10, 20]
        assert np.cos(2 * (turned - angle)) == pytest.approx(1.0)
    np.testing.assert_allclose(frames.axis_on_ray(np.array(0.0), v), 0.0, atol=1e-9)


def test_equal_vectors_in_float32_have_no_angle_and_opposite_ones_180_degrees() -> None:
    v = some_rays().astype(np.float32)
    assert (frames.angle_deg(v, v) == 0).all()
    np.testing.assert_allclose(frames.angle_deg(v, -v), 180, atol=0.1)
