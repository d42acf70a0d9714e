"""Light from the side, by the albedo: under a flash at the lens it does not depend on the slope of the surface.

The estimators assume one flash at the lens. A lamp at the side adds light where the surface leans towards it, and the
albedo that they find takes this light. So ln albedo is fitted by the normal's x and y. An object with a dark and a
bright half fits too, but not within its parts; noise of small parts fits, but not in the whole object. Both must agree.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics.morphology import erode
from polcap.optics.resize import block_means, block_step
from polcap.optics.robust import jackknife, spread
from polcap.stage_values import SurfaceMaps

_MOST_PIXELS = 1e4  # of the object; a larger picture is averaged down
_FACING = 0.35  # least z of a normal
_DARKEST = 0.01  # albedo
_CELL = 0.5  # side of a part, of the object's radius
_LEAST_PIXELS, _LEAST_CELLS = 300, 6  # of the averaged object; parts of it
_CAUCHY = 2.0  # robust standard deviations of the residuals: scale of the weights
_ROUNDS = 8  # of new weights
_SIGMAS = 2.0  # of the slope: how far its lower limit lies below it
_LEAST_SPREAD = 1e-6  # of the squares of the normals' x and y in the mean: a plane has no slope to compare


@dataclass(frozen=True)
class AlbedoSlope:
    """Change of ln albedo per unit of the normal's x and y, towards the brighter side: a lower limit, two σ below."""

    amount: float  # the smaller one of the whole object and of its parts; 0 without a lamp at the side
    azimuth: float  # rad, of the brighter side, from image x towards image up


def measure(maps: SurfaceMaps, usable: Bools) -> AlbedoSlope | None:
    """Measure how the albedo depends on the slope, in pixels `usable` (H, W); None for a small object."""
    chosen = maps.mask & usable
    step = block_step(chosen.sum(), _MOST_PIXELS)
    normal, albedo = (block_means(part, step) for part in (maps.normal, maps.diffuse.mean(axis=-1)))
    inside = erode(block_means(chosen.astype(np.float32), step) > 0.99, 1) & (normal[..., 2] > _FACING)
    y, x = np.nonzero(inside)
    side = max(_CELL * np.sqrt(len(x) / np.pi), 1.0)
    _, cell = np.unique(np.stack([y // side, x // side]), axis=1, return_inverse=True)
    if len(x) < _LEAST_PIXELS or cell.max() < _LEAST_CELLS:
        return None
    lean = normal[inside][:, :2].astype(np.float64)
    log = np.log(np.maximum(albedo[inside], _DARKEST)).astype(np.float64)
    overall = _fit(lean, log, np.zeros_like(cell), cell)
    slope, parts = overall[0], _fit(lean, log, cell, cell)
    towards = slope / max(float(np.linalg.norm(slope)), 1e-9)
    lower_limits = (towards @ value - _SIGMAS * np.hypot(*(towards * sigma)) for value, sigma in (overall, parts))
    return AlbedoSlope(max(float(min(lower_limits)), 0.0), float(np.arctan2(slope[1], slope[0])))


def _fit(lean: Floats, log: Floats, group: NDArray[Any], cell: NDArray[Any]) -> tuple[Floats, Floats]:
    """Slope (2,) of ln albedo (N,) over the normal's x and y (N, 2), robust, and its 1σ by a jackknife over the cells.

    Each group of pixels (N,) has a level of its own.
    """
    weight, least = np.ones_like(log), _LEAST_SPREAD * len(log) * np.eye(2)
    for _ in range(_ROUNDS):
        part, change = (_centered(value, weight, group) for value in (lean, log[:, None]))
        weighted = part * weight[:, None]
        slope = np.linalg.solve(weighted.T @ part + least, weighted.T @ change)[:, 0]
        residual = change[:, 0] - part @ slope
        weight = 1 / (1 + (residual / (_CAUCHY * spread(residual))) ** 2)
    products = weight[:, None] * np.column_stack([part[:, :1] * part, part[:, 1:] * part, part * change])  # (N, 6)
    of_cell = np.stack([np.bincount(cell, column) for column in products.T], axis=1)
    without = of_cell.sum(axis=0) - of_cell
    left, right = without[:, :4].reshape(-1, 2, 2) + least, without[:, 4:, None]
    return slope, jackknife(np.linalg.solve(left, right)[..., 0])


def _centered(value: Floats, weight: Floats, group: NDArray[Any]) -> Floats:
    """Values (N, C) minus the weighted mean of their group."""
    total = np.maximum(np.bincount(group, weight), 1e-9)
    mean = np.stack([np.bincount(group, weight * column) / total for column in value.T], axis=1)
    return np.asarray(value - mean[group])
