"""Projection of points: through a homography, and through a pinhole camera."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats, View


def transform_points(matrix: Floats, point: Floats) -> Floats:
    """Apply a homography (3, 3) to points x, y (…, 2)."""
    return np.stack(coordinates(matrix, point[..., 0], point[..., 1]), axis=-1)


def coordinates(matrix: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Apply a homography (3, 3) to coordinates x and y of shapes that broadcast; returns x and y, float64."""
    h = np.asarray(matrix, np.float64)
    u, v = (h[k, 0] * x + (h[k, 1] * y + h[k, 2]) for k in (0, 1))
    if abs(h[2, 0]) + abs(h[2, 1]) > 0 or h[2, 2] != 1:
        w = h[2, 0] * x + (h[2, 1] * y + h[2, 2])
        u, v = u / w, v / w
    return u, v


def to_grid(px: Any, scale: float) -> Any:
    """Positions (any shape) px on a grid whose pixels are `scale` px wide; pixel centers are whole numbers on both."""
    return (px - (scale - 1) / 2) / scale


def from_grid(px: Any, scale: float) -> Any:
    """Positions (any shape) from a grid whose pixels are `scale` px wide; inverse of `to_grid`."""
    return scale * px + (scale - 1) / 2


def picture_corners(width: int, height: int) -> Floats:
    """Centers x, y (4, 2) of the four corner pixels."""
    return np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)


def project(view: View, point: Floats) -> Floats:
    """Project points (…, 3) of the camera frame (x right, y up, z towards the camera) to pixels x, y (…, 2)."""
    x = view.center[0] - view.focal * point[..., 0] / point[..., 2]
    y = view.center[1] + view.focal * point[..., 1] / point[..., 2]
    return np.stack([x, y], axis=-1)


def back_project(view: View, x: Floats, y: Floats) -> Floats:
    """Points (…, 3) of the camera frame at depth 1 (z = −1) for pixels x, y (…,)."""
    across, up = ray_slopes(view, x, y)
    return np.stack([across, up, -np.ones_like(across)], axis=-1)


def ray_slopes(view: View, x: NDArray[Any], y: NDArray[Any]) -> tuple[Floats, Floats]:
    """Slopes X/−Z and Y/−Z (…,), in the camera frame, of the view rays through pixels x, y (…,)."""
    return (x - view.center[0]) / view.focal, (view.center[1] - y) / view.focal


def pixels_inside(quad: Floats, shape: tuple[int, ...], margin_px: float = 0.0) -> NDArray[np.int_]:
    """Pixels x, y (N, 2) of a picture (H, W, …) inside a convex quad (4, 2) px, clockwise on the screen.

    Pixels nearer than `margin_px` to one of its sides are left out.
    """
    x0, y0 = np.maximum(np.floor(quad.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(quad.max(axis=0)).astype(int) + 1, [shape[1], shape[0]])
    y, x = np.mgrid[y0 : max(y1, y0), x0 : max(x1, x0)]
    inside = np.ones(x.shape, bool)
    for (ax, ay), (bx, by) in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= margin_px * np.hypot(bx - ax, by - ay)
    return np.stack([x[inside], y[inside]], axis=-1)
