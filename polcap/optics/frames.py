"""Coordinate frames: the camera frame, view rays, and a right-handed frame for each ray.

Camera frame: x right, y up, z towards the camera; the scene lies at negative z. A ray v (unit vector, surface to
camera) has the frame (e_x, e_y, v), with e_x the camera's x axis projected onto the plane across the ray. The axis of
a polarizer is projected onto an oblique ray in the same way. Works on NumPy and torch; vectors on the last axis.
"""

from typing import Any

import numpy as np

from polcap.image_values import Floats, View
from polcap.optics.namespace import array_namespace
from polcap.optics.projection import back_project


def rays(view: View, height: int, width: int) -> Floats:
    """View rays: unit vectors (H, W, 3) from the surface to a pinhole camera, for each pixel."""
    return rays_at(view, *np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)))


def rays_at(view: View, x: Floats, y: Floats) -> Floats:
    """View rays: unit vectors (..., 3) from the surface to a pinhole camera, at pixel positions x, y (...,)."""
    towards = -back_project(view, x, y)
    return np.asarray(towards / (dot(towards, towards) ** 0.5)[..., None])


def basis(v: Any) -> tuple[Any, Any]:
    """The axes (e_x, e_y) of each ray's frame, v (..., 3) unit: e_x = x − (x·v) v made unit, e_y = v × e_x."""
    xp = array_namespace(v)
    vx, vy, vz = v[..., 0], v[..., 1], v[..., 2]
    length = _x_length(vx)
    e_x = xp.stack([length, -vx * vy / length, -vx * vz / length], axis=-1)
    return e_x, xp.stack([0 * vx, vz / length, -vy / length], axis=-1)


def _x_length(vx: Any) -> Any:
    """Length of the camera's x axis, projected onto the plane across a ray with x component `vx`."""
    return (1 - vx * vx) ** 0.5


def cross(a: Any, b: Any) -> Any:
    """Cross product a × b of vectors (..., 3)."""
    xp = array_namespace(a)
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    return xp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def dot(a: Any, b: Any) -> Any:
    """Dot product a · b of vectors (..., 3), four times as fast as a sum over the last axis."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def angle_deg(a: Floats, b: Floats) -> Floats:
    """Angles (...,) between unit vectors (..., 3), degrees; from their distance, for a cosine near 1 is imprecise."""
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(dot(a - b, a - b) ** 0.5 / 2, 0, 1))))


def total(a: Any) -> Any:
    """Sum of the three numbers on the last axis, four times as fast as the namespace's `sum`."""
    return a[..., 0] + a[..., 1] + a[..., 2]


def unit(a: Floats) -> Floats:
    """Unit vectors along vectors a (..., 3); 0 where a is 0."""
    return np.asarray(a / np.maximum(dot(a, a) ** 0.5, 1e-30)[..., None])


def to_ray_frame(n: Any, v: Any) -> Any:
    """Convert vectors n (..., 3) from the camera frame to the frames of the rays v (..., 3); see `basis`."""
    xp = array_namespace(n)
    vx, length, along = v[..., 0], _x_length(v[..., 0]), dot(n, v)
    across = n[..., 1] * v[..., 2] - n[..., 2] * v[..., 1]
    return xp.stack([(n[..., 0] - vx * along) / length, across / length, along], axis=-1)


def from_ray_frame(m: Any, v: Any) -> Any:
    """Convert vectors m (..., 3) from the frames of the rays v (..., 3) to the camera frame."""
    xp = array_namespace(m)
    vx, vy, vz = v[..., 0], v[..., 1], v[..., 2]
    length = _x_length(vx)
    x, y = m[..., 0] / length, m[..., 1] / length
    along = m[..., 2] - vx * x
    return xp.stack([x + vx * along, y * vz + vy * along, vz * along - y * vy], axis=-1)


def lifted(m: Any) -> Any:
    """Turn unit vectors (..., 3) in ray frames towards the camera: z becomes at least 0.02; unit length again."""
    xp = array_namespace(m)
    raised = xp.concat([m[..., :2], xp.clip(m[..., 2:], 0.02, None)], axis=-1)
    return raised / (dot(raised, raised) ** 0.5)[..., None]


def tilted(normal: Any, slope: Any) -> Any:
    """Normals (..., 3), not of unit length, after a height field of gradient `slope` (..., 3) is added to a surface.

    `normal` (..., 3) are its unit normals before; all vectors are in one frame.
    """
    return normal - slope + (slope * normal).sum(axis=-1, keepdims=True) * normal


def axis_across(angle: Any, v: Any) -> tuple[Any, Any]:
    """Project an axis in the image plane, such as a polarizer's, across each ray v (..., 3).

    The axis a = (cos θ, sin θ, 0), θ = `angle` [rad], becomes a − (a·v)v. Returns its components x and y (...,) along
    the axes (e_x, e_y) of the ray's frame; the length is arbitrary.
    """
    xp = array_namespace(v)
    vx, sine = v[..., 0], xp.sin(angle)
    return xp.cos(angle) * (1 - vx * vx) - sine * vx * v[..., 1], sine * v[..., 2]


def axis_on_ray(angle: Any, v: Any) -> Any:
    """Angle [rad] from e_x of an axis in the image plane, in the frame of each ray v; see `axis_across`."""
    x, y = axis_across(angle, v)
    return array_namespace(v).atan2(y, x)
