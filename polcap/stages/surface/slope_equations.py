"""Normals of the object's pixels -> the slopes that the integration fits, with their weights, on a pyramid of grids."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, SurfaceMaps, View
from polcap.optics.frames import dot
from polcap.stages.surface.occlusion import radius


@dataclass(frozen=True)
class Problem:
    """Normals of one pyramid level, on its N pixels."""

    mask: NDArray[np.bool_]  # (H, W)
    view: View
    normal: Floats  # (N, 3)
    weight: Floats  # (N,) 1 at the median error
    sigma: float  # rad, median error of the normals
    prior: Floats | None  # (N,) z of the prior
    pull: float  # weight of the prior


def problem(maps: SurfaceMaps, steepest: float, prior_weight: float) -> Problem:
    """The maps' normals, leaning at most `steepest` rad, as equations on their own grid."""
    mask = np.asarray(maps.mask, dtype=bool)
    normal = np.nan_to_num(maps.normal[mask].astype(np.float64))  # 0 is no normal: neighbours bridge it
    sigma = np.maximum(np.nan_to_num(maps.confidence[mask].astype(np.float64), nan=90.0, posinf=90.0), 1.0)
    middle = float(np.median(sigma))
    prior = None
    if maps.depth_prior is not None and prior_weight > 0:
        unit = radius(mask) / maps.view.focal  # the prior's over the distance
        prior = maps.view.focal * np.log(np.maximum(1 + unit * maps.depth_prior[mask], 0.05))
    return Problem(
        mask=mask,
        view=maps.view,
        normal=_capped(normal, mask, maps.view, steepest),
        weight=np.clip((middle / sigma) ** 2, 0.02, 50.0),
        sigma=np.radians(np.clip(middle, 1.0, 20.0)),
        prior=None if prior is None else prior.astype(np.float64),
        pull=prior_weight / max(int(mask.sum()), 1),
    )


def equations(of: Problem) -> tuple[Floats, Floats, Floats]:
    """m, and the right sides of the slopes to the right and down: (N,) each."""
    x, y = _slopes_of_rays(of.mask, of.view)
    n = of.normal
    return n[:, 2] - x * n[:, 0] - y * n[:, 1], n[:, 0], -n[:, 1]


def halved(of: Problem) -> Problem:
    """The same on blocks of 2×2 pixels: weighted means of what lies in the mask."""
    parent = parents(of.mask)
    count = np.bincount(parent).astype(np.float64)
    weight = np.bincount(parent, of.weight)
    normal: Floats = np.stack([np.bincount(parent, of.normal[:, k] * of.weight) for k in range(3)], axis=-1)
    normal /= np.maximum(dot(normal, normal) ** 0.5, 1e-12)[:, None]
    x, y = of.view.center
    return Problem(
        mask=_blocks(of.mask),
        view=View(of.view.focal / 2, ((x - 0.5) / 2, (y - 0.5) / 2), of.view.scale * 2),
        normal=normal,
        weight=weight / count,
        sigma=of.sigma,
        prior=None if of.prior is None else np.bincount(parent, of.prior) / count / 2,
        pull=4 * of.pull,
    )


def parents(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Number (N,) of the 2×2 block, among those that hold a pixel, in which each pixel of a mask (H, W) lies."""
    blocks = _blocks(mask)
    number = np.cumsum(blocks).reshape(blocks.shape) - 1
    row, column = np.nonzero(mask)
    return np.asarray(number[row // 2, column // 2], dtype=np.intp)


def _blocks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    padded = np.pad(mask, [(0, size % 2) for size in mask.shape])
    return np.asarray(padded[::2, ::2] | padded[1::2, ::2] | padded[::2, 1::2] | padded[1::2, 1::2])


def _capped(normal: Floats, mask: NDArray[np.bool_], view: View, steepest: float) -> Floats:
    """Normals turned towards the camera until they lean no more than `steepest` rad."""
    x, y = _slopes_of_rays(mask, view)
    facing = (normal[:, 2] - x * normal[:, 0] - y * normal[:, 1]) / np.sqrt(1 + x * x + y * y)
    over = np.flatnonzero(facing < np.cos(steepest) * np.sqrt(dot(normal, normal)))
    ray = np.stack([-x[over], -y[over], np.ones(len(over))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    across = normal[over] - facing[over, None] * ray
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    capped = normal.copy()
    capped[over] = np.cos(steepest) * ray + np.sin(steepest) * across / np.maximum(length, 1e-12)
    return capped


def _slopes_of_rays(mask: NDArray[np.bool_], view: View) -> tuple[Floats, Floats]:
    """a, b of the object's pixels: (N,) each."""
    row, column = np.nonzero(mask)
    return (column - view.center[0]) / view.focal, -(row - view.center[1]) / view.focal
