"""Slope equations of a normal map, with a weight per pixel, on grids of half the size each (a pyramid)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats, View
from polcap.optics.frames import dot
from polcap.optics.outline import disc_radius
from polcap.optics.projection import ray_slopes
from polcap.optics.reduction import scaled_view
from polcap.stage_values import SurfaceMaps

_LEAST_SIGMA_DEG = 1.0  # expected errors below count as this
_SIGMA_RANGE_DEG = (1.0, 20.0)  # of the median error that scales all residuals
_WEIGHTS = (0.02, 50.0)  # least and greatest weight of a normal, over the median's
LEAST_FACING = 0.05  # least cosine m that divides: flatter views give no slope
_LEAST_DEPTH = 0.05  # of the prior, over the object's distance


@dataclass(frozen=True)
class NormalField:
    """Normals, weights and prior of the N pixels of a mask, on one grid of the pyramid."""

    mask: Bools  # (H, W)
    view: View
    normal: Floats  # (N, 3)
    weight: Floats  # (N,) 1 at the median error
    sigma: float  # rad, median error of the normals
    prior: Floats | None  # (N,) scaled log depth [px]
    pull: float  # weight of the prior in each pixel


def normal_field(maps: SurfaceMaps, steepest: float, prior_weight: float) -> NormalField:
    """Prepare the maps' normals for integration: weights by their error, a depth prior, a limit of their tilt.

    A normal is at most `steepest` rad from its view ray. Pixels without a normal get the zero vector; the integration
    bridges them. `prior_weight` is that of the prior in all pixels together, so it does not depend on their number.
    """
    mask = np.asarray(maps.mask, dtype=bool)
    normal = np.nan_to_num(maps.normal[mask].astype(np.float64))
    sigma = np.nan_to_num(maps.confidence[mask].astype(np.float64), nan=90.0, posinf=90.0)  # degrees
    sigma = np.maximum(sigma, _LEAST_SIGMA_DEG)
    median = float(np.median(sigma))
    prior = None
    if maps.depth_prior is not None and prior_weight > 0:
        unit = disc_radius(mask) / maps.view.focal  # of `depth_prior`, over the object's distance
        depth = np.maximum(1 + unit * maps.depth_prior[mask], _LEAST_DEPTH)  # over that distance
        prior = (maps.view.focal * np.log(depth)).astype(np.float64)  # z = f ln d
    return NormalField(
        mask=mask,
        view=maps.view,
        normal=_limit_tilt(normal, mask, maps.view, steepest),
        weight=np.clip((median / sigma) ** 2, *_WEIGHTS),
        sigma=np.radians(np.clip(median, *_SIGMA_RANGE_DEG)),
        prior=prior,
        pull=prior_weight / max(int(mask.sum()), 1),
    )


def _limit_tilt(normal: Floats, mask: Bools, view: View, steepest: float) -> Floats:
    """Turn normals towards the camera until they are at most `steepest` rad from their view rays."""
    a, b = _ray_slopes(mask, view)
    facing = (normal[:, 2] - a * normal[:, 0] - b * normal[:, 1]) / np.sqrt(1 + a * a + b * b)
    over = np.flatnonzero(facing < np.cos(steepest) * np.sqrt(dot(normal, normal)))
    ray = np.stack([-a[over], -b[over], np.ones(len(over))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    across = normal[over] - facing[over, None] * ray
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    limited = normal.copy()
    limited[over] = np.cos(steepest) * ray + np.sin(steepest) * across / np.maximum(length, 1e-12)
    return limited


def slope_terms(field: NormalField) -> tuple[Floats, Floats, Floats]:
    """Coefficients m, n_x and −n_y of the slope equations, (N,) each.

    The equations are m ∂z/∂i = n_x and m ∂z/∂j = −n_y, i to the right, j down.
    """
    a, b = _ray_slopes(field.mask, field.view)
    n = field.normal
    return n[:, 2] - a * n[:, 0] - b * n[:, 1], n[:, 0], -n[:, 1]


def halve(field: NormalField) -> NormalField:
    """Normal field at half the resolution: weighted means over the masked pixels of each 2×2 block."""
    block = block_numbers(field.mask)
    count = np.bincount(block).astype(np.float64)
    weight = np.bincount(block, field.weight)
    normal: Floats = np.stack([np.bincount(block, field.normal[:, k] * field.weight) for k in range(3)], axis=-1)
    normal /= np.maximum(dot(normal, normal) ** 0.5, 1e-12)[:, None]
    return NormalField(
        mask=_any_of_blocks(field.mask),
        view=scaled_view(field.view, 0.5),
        normal=normal,
        weight=weight / count,
        sigma=field.sigma,
        prior=None if field.prior is None else np.bincount(block, field.prior) / count / 2,  # in px twice as wide
        pull=4 * field.pull,  # a pixel stands for four
    )


def block_numbers(mask: Bools) -> NDArray[np.intp]:
    """Number (N,) of each masked pixel's 2×2 block; blocks without a masked pixel are not counted."""
    blocks = _any_of_blocks(mask)
    number = np.cumsum(blocks).reshape(blocks.shape) - 1
    row, column = np.nonzero(mask)
    return np.asarray(number[row // 2, column // 2], dtype=np.intp)


def _any_of_blocks(mask: Bools) -> Bools:
    """Whether any pixel of each block of 2 × 2 is in the mask."""
    padded = np.pad(mask, [(0, size % 2) for size in mask.shape])
    return np.asarray(padded[::2, ::2] | padded[1::2, ::2] | padded[::2, 1::2] | padded[1::2, 1::2])


def _ray_slopes(mask: Bools, view: View) -> tuple[Floats, Floats]:
    """Slopes a, b of the view rays of the masked pixels, (N,) each."""
    row, column = np.nonzero(mask)
    return ray_slopes(view, column, row)
