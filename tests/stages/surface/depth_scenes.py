"""Scenes with a known depth in closed form, as maps of their true normals."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polcap.image_values import Floats, View
from polcap.mesh_values import ReliefMesh
from polcap.stage_values import SurfaceMaps

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


def error_share(mesh: ReliefMesh, truth: Floats, mask: NDArray[np.bool_]) -> float:
    """RMSE after the best scale, over the depth range."""
    d, t = mesh.depth[mask].astype(np.float64), truth[mask]
    scale = (d @ t) / (d @ d)
    return float(np.sqrt(np.mean((scale * d - t) ** 2)) / np.ptp(t))


def ball_in_a_ramp() -> tuple[SurfaceMaps, Floats, NDArray[np.bool_]]:
    """A ball sunk into a plane that recedes upwards: it hides the plane above, and meets it below."""
    _, b = slopes()
    ball, near = sphere(center=(0.0, 0.0, -1.0), radius=0.06)
    ramp = 1 / (1 - 0.8 * b)
    front = ball.mask & (np.nan_to_num(near, nan=9.0) < ramp)
    normal = np.where(front[..., None], ball.normal, from_depth(ramp))
    return maps(normal, np.ones(SHAPE, dtype=bool)), np.where(front, near, ramp), front


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


def two_balls(gap: float) -> tuple[SurfaceMaps, Floats]:
    """A small ball that hides part of a large one, `gap` m behind it, and their depth [m]."""
    small, near = sphere(center=(0.04, 0.0, -1.0), radius=0.045)
    large, far = sphere(center=(-0.02, 0.0, -1.045 - gap - 0.09), radius=0.09)
    front = small.mask
    normal = np.where(front[..., None], small.normal, large.normal)
    return maps(normal, front | large.mask), np.where(front, near, far)
