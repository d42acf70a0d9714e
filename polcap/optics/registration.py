"""Registration of two pictures of one scene by a translation, similarity or homography, to 0.02 px.

1. The pictures are averaged down to pyramids. On each scale the tiles with most detail are chosen.
2. From coarse to fine, each tile is matched independently by Gauss-Newton steps on its brightness. Each tile has its
   own gain and offset, so exposure, lighting and polarization may differ between tiles.
3. One motion is fitted robustly to the shifts of all tiles.

References
----------
Baker and Matthews, Lucas-Kanade 20 years on, IJCV 2004 (step 2). Kuglin and Hines, The phase correlation image
alignment method, 1975 (the start). Beaton and Tukey, Technometrics 1974 (biweight). Schwarz, Ann. Statist. 1978 (BIC).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics.projection import coordinates, transform_points
from polcap.optics.resize import block_means
from polcap.optics.tiles import spread_over_cells
from polcap.optics.warp import Spline, Taps

Indices = NDArray[np.int64]
Model = Literal["translation", "similarity", "homography", "simplest"]  # simplest: the model of least BIC

_SIZES = {"translation": (2,), "similarity": (4,), "homography": (8,), "simplest": (8, 4, 2)}  # numbers of parameters
_TILE = 20  # px; least error of sizes from 16 to 32 px (docs/benchmarks/registration.md)
_CELLS, _PER_CELL = 10, 8  # cells along each side of the picture; tiles chosen in each cell
_COARSEST_PX = 256  # least shorter side of a pyramid's picture: a smaller one has too few tiles
_TILES_AT_ONCE = 64  # matched together: their equations fit a core's cache
_LEAST_USABLE, _USABLE = 0.6, 0.7  # least usable share of a tile: in the other picture, in the reference
_MARGIN = 2  # px around a tile that interpolation reads
_REACH_PX = 2.0  # largest movement of a tile in one step
_GAIN = 0.2, 5.0  # range of a tile's gain; beyond, the two tiles show different things
_LEAST_TILES = 6
_TILE_ERROR_PX = 0.02  # of interpolation and aliasing, in the richest tile
_PRIOR_PX = 0.1  # prior 1σ of a parameter's change in one step
_AGREE_PX = 0.3  # a tile with a smaller residual agrees with the motion; after a smaller step, no new tiles are tried
_LEAST_AGREE = 0.4  # share of the matched tiles; if fewer agree, no motion is found
_FAR_BETTER = 1.25  # factor by which more tiles must agree with a distant match: detail may repeat
_STILL_PX = 1.0  # smaller motions need no search from coarse to fine
_SETTLED_PX = 0.005  # a smaller step ends the search; four times that on coarse scales
_STEPS, _COARSE_STEPS = 6, 4


@dataclass(frozen=True)
class Registration:
    """Result of a registration: the motion as a matrix, its error, and the number of tiles that agree."""

    matrix: Floats  # (3, 3) reference px (x, y, 1) → px of the other picture
    shift_px: float  # rms displacement of the matched tiles
    sigma_px: float  # 1σ of the displacement, rms over the tiles
    tiles: int  # matched; 0: no match, and the matrix is the identity
    covariance: Floats  # (P, P) of the motion's parameters, see `_design`
    shape: tuple[int, int]  # (H, W) of the reference

    def sigma_at(self, point: Floats) -> float:
        """Registration error: 1σ [px] per axis at a point x, y (2,); it grows with the distance from the tiles."""
        if not self.tiles:
            return np.inf
        lever = _design(_normalized(point[None], self.shape))[0, :, : len(self.covariance)]
        return float(np.sqrt(np.trace(lever @ self.covariance @ lever.T) / 2))


@dataclass(frozen=True)
class Level:
    """One scale of a picture's pyramid; its tiles and spline are computed at first use."""

    picture: Floats  # (H, W)
    usable: Bools  # (H, W)

    @cached_property
    def tiles(self) -> Indices:
        """Corners (T, 2) = (row, column) of the tiles with most detail, spread over the picture."""
        rows, columns = (self.picture.shape[0] - 2) // _TILE, (self.picture.shape[1] - 2) // _TILE
        if rows < 1 or columns < 1:
            return np.zeros((0, 2), np.int64)
        cut = np.s_[: rows * _TILE, : columns * _TILE]
        score = block_means((squared_gradient(self.picture) * self.usable)[cut], _TILE)
        score *= block_means(self.usable[cut], _TILE) > _USABLE
        return _TILE * spread_over_cells(score, (_CELLS, _CELLS), _PER_CELL)

    @cached_property
    def spline(self) -> Spline:
        return Spline(self.picture)


class Pyramid:
    """A picture at full size, half, a quarter …; coarse levels are computed at first use."""

    def __init__(self, picture: Floats, usable: Bools) -> None:
        """Start from a lightly smoothed picture (H, W) of nearly uniform noise, and its usable pixels (H, W)."""
        self._levels = [Level(picture, usable)]
        self.scales = 1
        while min(picture.shape) // 2 ** (self.scales - 1) >= _COARSEST_PX:
            self.scales += 1
        self.shape = picture.shape[0], picture.shape[1]

    def __getitem__(self, scale: int) -> Level:
        """The picture at 2^-scale of the full size."""
        while len(self._levels) <= scale:
            finer = self._levels[-1]
            self._levels.append(Level(block_means(finer.picture, 2), block_means(finer.usable, 2) > 0.99))
        return self._levels[scale]


@dataclass(frozen=True)
class _Matches:
    """Residual shifts of tiles between two pictures under a motion."""

    corner: Indices  # (T, 2) = (row, column) of the tiles in the reference
    shift: Floats  # (T, 2) px
    information: Floats  # (T, 2, 2) inverse covariance of the shift [px⁻²]

    @property
    def point(self) -> Floats:
        """Tile centers x, y (T, 2) in the reference, px."""
        return np.asarray(self.corner[:, ::-1] + (_TILE - 1) / 2)


def register(reference: Pyramid, other: Pyramid, model: Model = "simplest") -> Registration:
    """Estimate the motion from a reference picture to another picture of the same scene.

    First the pictures are matched at full size. The result is used if it, the coarsest scale and a phase correlation
    all show a motion below `_STILL_PX`. Otherwise the search goes from coarse to fine, starting from the identity and
    from the phase correlation. If no tiles match or agree, the result is the identity with `tiles` 0.
    """
    coarsest = reference.scales - 1
    still, _ = _refine(reference, other, model, 0, 0, np.eye(3))
    start = _phase_correlation(reference[coarsest], other[coarsest])
    if start[:2, 2].any():
        near, near_tiles = _refine(reference, other, model, coarsest, 0, np.eye(3))
        far, far_tiles = _refine(reference, other, model, coarsest, 0, start)
        return far if far_tiles > _FAR_BETTER * near_tiles else near
    coarse, _ = _refine(reference, other, model, coarsest, coarsest, np.eye(3))
    if min(still.tiles, coarse.tiles) and max(still.shift_px, coarse.shift_px * 2**coarsest) < _STILL_PX:
        return still
    return _refine(reference, other, model, coarsest, 0, np.eye(3))[0]


def refine(reference: Pyramid, other: Pyramid, model: Model, start: Floats) -> Registration:
    """Refine a first guess (3, 3) of the motion between two pictures; returns the guess where no tiles match."""
    coarsest = reference.scales - 1
    found, _ = _refine(reference, other, model, coarsest, 0, scaled(start, 1 / 2**coarsest))
    return found if found.tiles else replace(found, matrix=start)


def correlation(reference: Pyramid, other: Pyramid, matrix: Floats) -> float:
    """Pearson's correlation of two pictures under a motion (3, 3), over pixels usable in both; 0 without any."""
    a, b = reference[0], other[0]
    size, inverse = a.picture.shape[::-1], cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(b.usable.view(np.uint8), matrix, size, flags=inverse | cv2.INTER_NEAREST, borderValue=0)
    usable = a.usable & (seen > 0)
    options = {"flags": inverse | cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REPLICATE}
    warped = cv2.warpPerspective(b.picture, matrix, size, **options)
    if not usable.any():
        return 0.0
    x, y = a.picture[usable] - a.picture[usable].mean(), warped[usable] - warped[usable].mean()
    return float(np.vdot(x, y) / np.sqrt(float(np.vdot(x, x)) * float(np.vdot(y, y)) + 1e-30))


def scaled(matrix: Floats, step: float) -> Floats:
    """Convert a motion (3, 3) from a grid that is averaged down by `step` to the full grid; with 1/step, back."""
    to_full = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
    return np.asarray(to_full @ matrix @ np.linalg.inv(to_full))


def squared_gradient(picture: Floats) -> Floats:
    """Squared gradient (h, w) of a picture (h, w) by central differences, per px²."""
    gx, gy = (
        np.asarray(cv2.Sobel(picture, cv2.CV_32F, x, 1 - x, ksize=1, scale=0.5, borderType=cv2.BORDER_REPLICATE))
        for x in (1, 0)
    )
    gx *= gx
    gy *= gy
    gx += gy
    return gx


def _phase_correlation(reference: Level, other: Level) -> Floats:
    """Whole-pixel shift between two pictures, a matrix (3, 3); the identity unless its peak is 1.5 times that at 0."""
    a, b, both = reference.picture, other.picture, reference.usable & other.usable
    window = np.outer(np.hanning(a.shape[0]), np.hanning(a.shape[1]))
    if both.mean() < 0.05:
        return np.eye(3)
    flat = [window * np.where(both, p - p[both].mean(), 0) for p in (a, b)]
    cross = np.conj(np.fft.rfft2(flat[0])) * np.fft.rfft2(flat[1])
    strength = np.abs(cross)
    if not strength.max() > 0:  # one picture is uniform
        return np.eye(3)
    peaks = np.fft.irfft2(cross / (strength + 1e-3 * strength.max()), s=a.shape)
    dy, dx = (int(v) for v in np.unravel_index(int(np.argmax(peaks)), a.shape))
    dy, dx = dy - a.shape[0] * (dy > a.shape[0] // 2), dx - a.shape[1] * (dx > a.shape[1] // 2)
    if peaks[dy, dx] < 1.5 * peaks[0, 0]:
        dy = dx = 0
    return np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])


def _refine(
    reference: Pyramid, other: Pyramid, model: Model, coarsest: int, finest: int, matrix: Floats
) -> tuple[Registration, int]:
    """Refine a first guess of the motion, from the scale `coarsest` to the scale `finest`, in px of the latter.

    Returns the registration and the number of tiles that agree with it.
    """
    sigma, agree = np.inf, 0
    points: Floats = np.zeros((0, 2))
    covariance: Floats = np.zeros((2, 2))
    for level in range(coarsest, finest - 1, -1):
        a, b = reference[level], other[level]
        points, corner = np.zeros((0, 2)), a.tiles
        for _ in range(_COARSE_STEPS if level else _STEPS):
            matches = _match(a, b, corner, matrix)
            if len(matches.corner) < _LEAST_TILES:
                break
            update, covariance, sigma = _fit(matches, a.picture.shape, model)
            matrix = matrix @ update
            points = matches.point
            step = transform_points(update, points) - points
            residual, largest = matches.shift - step, float(np.abs(step).max())
            agree = int(np.sum(np.hypot(residual[:, 0], residual[:, 1]) < _AGREE_PX))
            if largest < _SETTLED_PX * (4 if level else 1):
                break
            if largest < _AGREE_PX:
                corner = matches.corner
        if level > finest:
            matrix = scaled(matrix, 2)
    shape = reference[finest].picture.shape
    if not len(points) or agree < _LEAST_AGREE * len(points):
        return Registration(np.eye(3), 0.0, np.inf, tiles=0, covariance=covariance, shape=shape), 0
    matrix = matrix / matrix[2, 2]
    moved = transform_points(matrix, points) - points
    shift_px = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    return Registration(matrix, shift_px, sigma, len(points), covariance, shape), agree


def _match(reference: Level, other: Level, corner: Indices, matrix: Floats) -> _Matches:
    """Estimate the residual shift δ of each tile under a motion, by one Gauss-Newton step.

    It solves reference(x) = gain · (other(x') + ∇·δ) + offset.
    """
    parts = [
        _match_some(reference, other, part, matrix)
        for part in np.split(corner, range(_TILES_AT_ONCE, len(corner), _TILES_AT_ONCE))
    ]
    return _Matches(*(np.concatenate(values) for values in zip(*parts)))


def _match_some(reference: Level, other: Level, corner: Indices, matrix: Floats) -> tuple[Indices, Floats, Floats]:
    """Match some tiles: corners, shifts and information of the tiles that match."""
    height, width = other.picture.shape
    offset = np.arange(float(_TILE))
    u, v = coordinates(matrix, corner[:, 1, None, None] + offset, corner[:, 0, None, None] + offset[:, None])
    inside = (u.min((1, 2)) >= _MARGIN) & (u.max((1, 2)) < width - 1 - _MARGIN)
    inside &= (v.min((1, 2)) >= _MARGIN) & (v.max((1, 2)) < height - 1 - _MARGIN) & (corner.min(axis=1) >= 1)
    corner, u, v = corner[inside], u[inside], v[inside]
    clear = other.usable[np.rint(v).astype(int), np.rint(u).astype(int)]
    enough = clear.mean((1, 2)) > _LEAST_USABLE
    corner, u, v, clear = corner[enough], u[enough], v[enough], clear[enough]
    count = len(corner)
    if not count:
        return corner, np.zeros((0, 2)), np.zeros((0, 2, 2))
    usable = np.asarray(clear & _windows(reference.usable, corner, _TILE), np.float64)
    patch = _windows(reference.picture, corner - 1, _TILE + 2).astype(np.float64)
    taps = Taps(u.reshape(-1, _TILE), v.reshape(-1, _TILE), (height, width))
    sampled = other.spline.at(taps).reshape(u.shape).astype(np.float64)
    gx = (patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]) / 2
    gy = (patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]) / 2
    weight = usable.reshape(count, 1, -1)
    basis = np.stack([gx, gy, sampled, usable], axis=1).reshape(count, 4, -1) * weight
    normal = basis @ basis.transpose(0, 2, 1)  # unknowns: shift, gain, offset
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-30) * np.eye(4)
    target = patch[:, 1:-1, 1:-1].reshape(count, -1) * weight[:, 0]
    solution = np.linalg.solve(normal, basis @ target[..., None])[..., 0]
    residual = target - (solution[:, None] @ basis)[:, 0]
    pixels = usable.sum((1, 2))
    variance = (residual**2).sum(axis=1) / np.maximum(pixels - 4, 1) + 1e-12
    shift, information = _without_noise(solution[:, :2], normal, pixels, variance)
    good = np.all(np.abs(shift) < _REACH_PX, axis=1) & np.any(information != 0, axis=(1, 2))
    good &= (solution[:, 2] > _GAIN[0]) & (solution[:, 2] < _GAIN[1])
    return corner[good], shift[good], information[good]


def _without_noise(shift: Floats, normal: Floats, count: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Correct the shifts (T, 2) of tiles for noise of their gradients, which makes them too small.

    In the normal matrix (T, 4, 4) of each tile, noise adds half the `variance` (T,) of each of its `count` (T,) pixels.
    Directions dominated by noise get the shift 0. Also returns the information (T, 2, 2) of the shifts.
    """
    of_shift = np.linalg.inv(np.linalg.inv(normal)[:, :2, :2])
    power, axes = np.linalg.eigh(of_shift)
    scene = power - 0.5 * (count * variance)[:, None]
    clear = scene > 0.5 * power
    along = np.einsum("tik,ti->tk", axes, shift) * power / np.maximum(scene, 0.5 * power + 1e-300)
    corrected = np.einsum("tik,tk->ti", axes, np.where(clear, along, 0))
    information = np.einsum("tik,tk,tjk->tij", axes, np.where(clear, scene, 0) / variance[:, None], axes)
    return corrected, information


def _windows(picture: NDArray[Any], corner: Indices, size: int) -> NDArray[Any]:
    """Cut squares (T, size, size) out of a picture (H, W), at corners (T, 2) = (row, column)."""
    windows = np.lib.stride_tricks.sliding_window_view(picture, (size, size))
    return np.asarray(windows[corner[:, 0], corner[:, 1]])


def _fit(matches: _Matches, shape: tuple[int, ...], model: Model) -> tuple[Floats, Floats, float]:
    """Fit one motion (3, 3) to the shifts of all tiles.

    Returns also the covariance (P, P) of its parameters, and the rms 1σ of the shifts [px].
    """
    design = _design(_normalized(matches.point, shape))
    # interpolation limits the tiles with most detail
    power, axes = np.linalg.eigh(matches.information)
    limited = 1 / (1 / np.maximum(power, 1e-9) + _TILE_ERROR_PX**2)
    information = np.einsum("tik,tk,tjk->tij", axes, limited, axes)
    sizes = [k for k in _SIZES[model] if k <= len(matches.point)] or [2]
    fits = [_robust(design[..., :k], matches.shift, information) for k in sizes]
    # χ² per degree of freedom, by the model with most parameters
    spread = max(1.0, fits[0].chi2 / max(2 * float(fits[0].weight.sum()) - sizes[0], 1.0))
    bic = [fit.chi2 / spread + k * np.log(2 * len(matches.point)) for k, fit in zip(sizes, fits)]
    k, best = sizes[int(np.argmin(bic))], fits[int(np.argmin(bic))]
    covariance = best.covariance * spread
    each = np.einsum("tik,kl,til->t", design[..., :k], covariance, design[..., :k])
    return _motion(best.parameters, shape), covariance, float(np.sqrt(each.mean()))


def _normalized(point: Floats, shape: tuple[int, ...]) -> Floats:
    """Points x, y (T, 2) px relative to the picture's center, in units of half its longer side."""
    return np.asarray((point - [(shape[1] - 1) / 2, (shape[0] - 1) / 2]) / (max(shape) / 2))


def _design(u: Floats) -> Floats:
    """Displacement (T, 2, 8) of normalized points (T, 2) per unit of each of the 8 motion parameters.

    Parameters 0 and 1 are a translation, 2 and 3 complete a similarity, 4 to 7 a homography.
    """
    x, y = u[:, 0], u[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    dx = [one, zero, x, -y, x, y, x * x, x * y]
    dy = [zero, one, y, x, -y, x, x * y, y * y]
    return np.stack([np.stack(dx, -1), np.stack(dy, -1)], axis=1)


def _motion(parameters: Floats, shape: tuple[int, ...]) -> Floats:
    """Homography (3, 3) in px from motion parameters as of `_design`."""
    h, w = shape
    scale = max(h, w) / 2
    p = np.zeros(8)
    p[: len(parameters)] = parameters
    about_middle = np.array(
        [
            [1 + (p[2] + p[4]) / scale, (-p[3] + p[5]) / scale, p[0]],
            [(p[3] + p[5]) / scale, 1 + (p[2] - p[4]) / scale, p[1]],
            [-p[6] / scale**2, -p[7] / scale**2, 1],
        ]
    )
    middle = np.array([[1, 0, (w - 1) / 2], [0, 1, (h - 1) / 2], [0, 0, 1.0]])
    return np.asarray(middle @ about_middle @ np.linalg.inv(middle))


@dataclass(frozen=True)
class _RobustFit:
    """Result of a robust least-squares fit."""

    parameters: Floats  # (P,)
    covariance: Floats  # (P, P)
    chi2: float
    weight: Floats  # (T,)


def _robust(design: Floats, shift: Floats, information: Floats) -> _RobustFit:
    """Fit the parameters to shifts (T, 2) by least squares, reweighted by Tukey's biweight."""
    weight = np.ones(len(shift))
    k = design.shape[2]
    parameters: Floats = np.zeros(k)
    covariance: Floats = np.eye(k)
    chi2 = np.zeros(len(shift))
    informed = information @ design  # (T, 2, P)
    for _ in range(10):
        weighted = (weight[:, None, None] * informed).reshape(-1, k).T
        normal, right = weighted @ design.reshape(-1, k), weighted @ shift.ravel()
        parameters = np.linalg.solve(normal + np.eye(k) / _PRIOR_PX**2, right)
        covariance = np.linalg.inv(normal + np.eye(k))  # with a prior 1σ of 1 px, so that the inverse exists
        residual = shift - design @ parameters
        chi2 = np.einsum("ti,tij,tj->t", residual, information, residual)
        scale = max(float(np.median(chi2)) / 1.386, 1e-6)  # χ² of two has median 1.386
        weight = np.clip(1 - chi2 / (25 * scale), 0, None) ** 2  # 0 beyond 5σ
    return _RobustFit(parameters, covariance, float(np.sum(weight * chi2)), weight)
