"""Planar faces of an object: parts of its normal map with nearly one normal.

**Their side.** A plane recedes towards t, the part of its normal across the ray. At the distance ρ from the flash, its
irradiance is proportional to ρ⁻³: one factor 1/ρ is the cosine of incidence. So its log light decreases towards t by
3 tan θ per radian of the picture, if the albedo is constant. A robust fit separates this gradient from changes of the
albedo, which mostly change the color, too.

**Their variation.** An estimated normal map of a plane is not constant: it follows prints, highlights and noise. A
face counts as a plane if its smoothed normals vary by less than their expected error, and by less than 7° RMS. Normals
of a curved surface that fill the same 20° around one direction vary by more. The mean replaces the smoothed normals;
finer relief stays.

References
----------
Page, Approximations to the cumulative normal function and its inverse, Applied Statistics 1977.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import clusters, frames, robust
from polcap.optics.morphology import erode, masked_mean
from polcap.optics.resize import area_mean, weighted_area_mean

_LONGEST = 128  # cells of the grid's longer side
_ALIKE_DEG = 20.0  # greatest angle between one normal and those of its face
_SHARE, _FEWEST_CELLS = 0.08, 50  # of the grid, and number of cells: least size of a face
_CANDIDATES = 300  # normals of faces
# the light of the flash; docs/benchmarks/half-turns.md
_SPREAD_DEG = 9.0  # greatest RMS angle of a plane's normals to their mean
_COLORS = 6
_ALBEDO_SIGMAS = 2.0  # factor on the fit's 1σ: albedo that changes without a change of color
_FLASH_GRADIENT = 0.5  # per rad, 1σ: place of the flash, its beam, vignetting; 7 cm at 0.7 m are 0.3
_STEEPEST = 11.0  # per rad: a plane tilted by 75°
_ALONG = 0.7  # least cosine between gradient and axis of the plane
_MOST_ODDS = 6.0  # ln odds
_STEPS, _LEAST_RESIDUAL = 8, 0.003  # of the robust fit; ln light
_TILE = 8  # cells, side of a tile in which residuals of the fit may be correlated
# the variation; docs/benchmarks/surface.md
_SMOOTH = 0.03  # 1σ over the grid's longer side
# greatest RMS angle of a plane's smoothed normals to their mean: over their expected error, and in degrees; beyond this
# share of it, they are flattened in part only
_OF_ERROR, _CURVED_DEG, _CERTAIN = 0.8, 7.0, 0.75


@dataclass(frozen=True)
class FlashPicture:
    """Picture of an object under a flash near the lens, with its view rays."""

    radiance: Floats  # (H, W, 3)
    rays: Floats  # (H, W, 3) unit vectors to the camera


def grid_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape (h, w) of the coarse grid of a picture (H, W)."""
    shrink = max(1.0, max(shape) / _LONGEST)
    return tuple(max(8, round(side / shrink)) for side in shape)


def faces(normal: Floats, mask: Bools, *, half_turns: bool = False) -> Iterator[Bools]:
    """Yield connected parts (h, w) of a mask (h, w) in which unit normals (h, w, 3) are nearly one, the largest first.

    `half_turns`: the normals are in ray frames, and their azimuth is known up to 180°.
    """
    normals = normal.reshape(-1, 3)
    least = max(_FEWEST_CELLS, _SHARE * mask.sum())
    remaining = mask.copy()
    while remaining.sum() >= least:
        cells = np.flatnonzero(remaining)
        candidates = normals[cells[:: max(1, len(cells) // _CANDIDATES)]].T
        cosine = normals[cells] @ candidates
        if half_turns:
            cosine = np.maximum(cosine, (normals[cells] * [-1, -1, 1]) @ candidates)
        similar = cosine > np.cos(np.radians(_ALIKE_DEG))
        part = np.zeros(remaining.shape, np.uint8)
        part.flat[cells] = similar[:, similar.sum(axis=0).argmax()]
        if not part.any():  # means of opposite normals are like none, not even themselves
            return
        _, label, statistics, _ = cv2.connectedComponentsWithStats(part, connectivity=4)
        largest = 1 + int(statistics[1:, cv2.CC_STAT_AREA].argmax())
        if statistics[largest, cv2.CC_STAT_AREA] < least:
            return
        remaining &= label != largest
        yield label == largest


def light_odds(lean: Floats, inside: Bools, flash: FlashPicture, mask: Bools) -> Floats:
    """Log odds (h, w) that normals of planes lean to the wrong side, by the light of the flash; 0 where no plane is.

    `lean` (2, h, w) and `inside` (h, w) are lean and mask of a `half_turns.Grid`; `flash` and `mask` have the size of
    the picture.
    """
    shape = inside.shape
    light = np.log(np.maximum([weighted_area_mean(c, mask, shape) for c in np.moveaxis(flash.radiance, -1, 0)], 1e-3))
    x, y, z = (area_mean(c.astype(np.float32), shape) for c in np.moveaxis(flash.rays, -1, 0))
    place = -np.stack([x, y]) / z  # (2, h, w) tangents of the picture angles, x right, y up
    sine = np.hypot(*lean)
    axis = lean / np.maximum(sine, 1e-6)
    odds = np.zeros(shape)
    normal = np.moveaxis(np.stack([*lean, np.sqrt(np.maximum(1 - sine**2, 0))]), 0, -1)
    for face in faces(normal, inside, half_turns=True):
        plane = erode(face, 1)  # without the mixed light of edges
        if plane.sum() < _FEWEST_CELLS:
            continue
        azimuth = np.angle(((axis[0] + 1j * axis[1]) ** 2 * sine)[plane].sum()) / 2  # mean of axes, by double angles
        mean_axis = np.array([np.cos(azimuth), np.sin(azimuth)])
        gradient, covariance = _light_gradient(light[:, plane].T, place[:, plane].T, _tiles(plane))
        along = abs(gradient @ mean_axis) > _ALONG * np.hypot(*gradient)
        if along and np.hypot(*gradient) < _STEEPEST and _spread_deg(lean[:, plane], mean_axis) < _SPREAD_DEG:
            lean_axis = axis[:, face]
            variance = np.einsum("in,ij,jn->n", lean_axis, covariance, lean_axis) + _FLASH_GRADIENT**2
            rise = gradient @ lean_axis / np.sqrt(variance)  # of the light towards the lean, σ
            odds[face] = 1.6 * rise + 0.07 * rise**3  # ln Φ / (1 − Φ), Page 1977
    return np.clip(odds, -_MOST_ODDS, _MOST_ODDS)


def flatten(normal: Floats, error: Floats, mask: Bools) -> Floats:
    """Replace the smooth part of unit normals (H, W, 3) in each planar face of a mask (H, W) by its mean.

    `error` (H, W) is their expected error, degrees.
    """
    shape = grid_shape(mask.shape)
    inside = area_mean(mask, shape) > 0.5
    coarse, expected = frames.unit(weighted_area_mean(normal, mask, shape)), weighted_area_mean(error, mask, shape)
    change = np.zeros(coarse.shape, np.float32)
    for face in faces(coarse, inside):
        part = _continued(face, coarse, inside)
        smooth = frames.unit(masked_mean(coarse, part, _SMOOTH * max(shape)))
        mean = frames.unit(np.median(smooth[part], axis=0))
        angle = np.sqrt(np.mean(frames.angle_deg(smooth[part], mean) ** 2))
        most = min(_OF_ERROR * float(expected[part].mean()), _CURVED_DEG)
        change[face] = np.clip((1 - angle / most) / (1 - _CERTAIN), 0, 1) * (mean - smooth[face])
    return frames.unit(normal + cv2.resize(change, mask.shape[::-1])) * mask[..., None]


def _continued(face: Bools, normal: Floats, mask: Bools) -> Bools:
    """Extend a face (h, w) by connected cells that are like its mean normal, also those of other faces.

    A strip of a curved surface between two other faces varies little; the cells around it show the curvature.
    """
    mean = frames.unit(np.median(normal[face], axis=0))
    alike = mask & (face | (frames.dot(normal, mean) > np.cos(np.radians(_ALIKE_DEG))))
    label = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)[1]
    return np.isin(label, np.unique(label[face]))


def _light_gradient(light: Floats, place: Floats, tile: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Gradient (2,) of the log light (N, 3) of a plane over its places (N, 2), beyond that of its colors.

    Also returns its covariance (2, 2) by the sandwich estimator: residuals in the same `tile` (N,) may be correlated.
    """
    color = light[:, [0, 2]] - light[:, [1]]
    share = clusters.soft_share(color, *clusters.color_clusters(color, _COLORS))
    design = np.concatenate([share, place - place.mean(axis=0)], axis=1)
    gray = light.mean(axis=1)
    weight: Floats = np.ones(len(light))
    ridge = np.diag([1e-6] * share.shape[1] + [1e-9] * 2) * len(light)  # for colors with few cells, and thin planes
    for _ in range(_STEPS):
        inverse = np.linalg.inv(design.T @ (weight[:, None] * design) + ridge)
        fitted = inverse @ design.T @ (weight * gray)
        residual = gray - design @ fitted
        weight = robust.biweight(residual, robust.spread(residual) + _LEAST_RESIDUAL)
    score = np.zeros((tile.max() + 1, design.shape[1]))
    np.add.at(score, tile, (weight * residual)[:, None] * design)
    covariance = inverse @ score.T @ score @ inverse
    return fitted[-2:], _ALBEDO_SIGMAS**2 * covariance[-2:, -2:]


def _tiles(inside: Bools) -> NDArray[np.intp]:
    """Number of the tile of each cell in a mask (h, w), (N,)."""
    row, column = np.nonzero(inside)
    return np.unique(row // _TILE * inside.shape[1] + column // _TILE, return_inverse=True)[1]


def _spread_deg(lean: Floats, axis: Floats) -> float:
    """RMS angle of normals with these leans (2, N) to their mean, each turned to the side of the axis (2,), degrees."""
    lean = lean * np.where(axis @ lean < 0, -1, 1)
    normal = np.stack([*lean, np.sqrt(np.maximum(1 - (lean**2).sum(axis=0), 0))], axis=1)
    angle = frames.angle_deg(normal, frames.unit(normal.mean(axis=0)))
    return float(np.sqrt(np.mean(angle**2)))
