"""Where one picture sees what another sees: sub-pixel homography between frames of one bracket.

Small tiles are matched one by one (Gauss-Newton on the brightness, their own gain left free), coarse to
fine; a translation, a similarity or a homography is then fitted robustly to the tiles' shifts, the
simplest that explains them.

References
----------
Baker and Matthews, Lucas-Kanade 20 years on, IJCV 2004; Schwarz, Ann. Statist. 1978 (BIC).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.hdr.ghosts import edges

TILE = 32  # px
_AT_ONCE = 64  # tiles whose equations fit a core's cache
_CELLS, _PER_CELL = 10, 3  # tiles are spread over the picture: the best few of each cell
_REACH = 2.0  # px a tile may move in one step
_SETTLED = 0.005  # px; a smaller step ends the search


Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Motion:
    """Reference px (x, y, 1) → px of the other picture, with how far it may be trusted."""

    matrix: Floats  # (3, 3)
    shift_px: float  # rms displacement over the matched tiles
    sigma_px: float  # 1σ of a typical displacement
    tiles: int  # that took part; 0: nothing to match, matrix is the identity


@dataclass(frozen=True)
class _Matches:
    point: Floats  # (T, 2) tile centres x, y in the reference
    shift: Floats  # (T, 2) still missing, px
    information: Floats  # (T, 2, 2) inverse covariance of the shift


class View:
    """One picture at all scales, each made when it is asked for."""

    def __init__(self, picture: Floats, usable: Bools) -> None:
        """A picture to compare, at several scales.

        Parameters
        ----------
        picture
            (H, W) of about even noise (a square root of radiance), lightly smoothed.
        usable
            (H, W) which pixels are exposed well enough to be compared.
        """
        self._levels = [(picture, usable)]
        self._tiles: dict[int, NDArray[np.int64]] = {}
        self.scales = 1
        while min(picture.shape) // 2 ** (self.scales - 1) >= 8 * TILE:
            self.scales += 1

    def __getitem__(self, scale: int) -> tuple[Floats, Bools]:
        """The picture at 2^-scale of its size, and its usable pixels."""
        while len(self._levels) <= scale:
            picture, usable = self._levels[-1]
            self._levels.append((_half(picture), _half(usable) > 0.99))
        return self._levels[scale]

    def tiles(self, scale: int) -> NDArray[np.int64]:
        """Corners (T, 2) = (row, column) of the tiles with most detail, spread over the picture."""
        if scale not in self._tiles:
            self._tiles[scale] = _choose(*self[scale])
        return self._tiles[scale]


def estimate(reference: View, other: View) -> Motion:
    """Register two pictures."""
    still, agree = _refine(reference, other, 1, np.eye(3))
    if still.shift_px < 1 and agree > 0.6 * still.tiles:  # look no further
        return still
    scales = reference.scales
    near, agree = _refine(reference, other, scales, np.eye(3))
    start = _coarse(*reference[scales - 1], *other[scales - 1])
    far, more = _refine(reference, other, scales, start)
    return far if more > 1.25 * agree else near  # of repeated detail the nearest match is taken


def _refine(reference: View, other: View, scales: int, matrix: Floats) -> tuple[Motion, float]:
    """Coarse to fine from a first guess on the coarsest of some scales; with it the number of tiles that agree.

    No motion is reported where fewer than two in five do.
    """
    sigma, agree = np.inf, 0.0
    points: Floats = np.zeros((0, 2))
    for level in range(scales - 1, -1, -1):
        (a, _), (b, ok_b), tiles = reference[level], other[level], reference.tiles(level)
        points = np.zeros((0, 2))
        for _ in range(4 if level else 6):
            matches = _match(a, b, ok_b, tiles, matrix)
            if len(matches.point) < 6:
                break
            flow, sigma = _fit(matches, a.shape)
            matrix = matrix @ flow
            points = matches.point
            rest = matches.shift - (apply(flow, points) - points)
            agree = float(np.sum(np.hypot(rest[:, 0], rest[:, 1]) < 0.3))
            step = apply(flow, points) - points
            if float(np.abs(step).max()) < _SETTLED * (4 if level else 1):
                break
        if level:  # a coarse pixel's centre lies half a pixel in
            finer = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
            matrix = finer @ matrix @ np.linalg.inv(finer)
    if not len(points) or agree < 0.4 * len(points):
        return Motion(np.eye(3), 0.0, np.inf, 0), 0.0
    matrix = matrix / matrix[2, 2]
    moved = apply(matrix, points) - points
    return Motion(matrix, float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))), sigma, len(points)), agree


def apply(matrix: Floats, point: Floats) -> Floats:
    """Points (N, 2), or any (…, 2), through a homography (3, 3)."""
    x = point @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(x[..., :2] / x[..., 2:])


def _half(picture: Floats | NDArray[np.bool_]) -> Floats:
    h, w = picture.shape[0] // 2, picture.shape[1] // 2
    even = picture[: 2 * h, : 2 * w].astype(np.float32, copy=False)
    return np.asarray(cv2.resize(even, (w, h), interpolation=cv2.INTER_AREA))


def _coarse(a: Floats, ok_a: Bools, b: Floats, ok_b: Bools) -> Floats:
    """Whole-pixel shift by phase correlation of what both can see; the identity unless clearly better."""
    window = np.outer(np.hanning(a.shape[0]), np.hanning(a.shape[1]))
    both = ok_a & ok_b
    if both.mean() < 0.05:
        return np.eye(3)
    flat = [window * np.where(both, p - p[both].mean(), 0) for p in (a, b)]
    cross = np.conj(np.fft.rfft2(flat[0])) * np.fft.rfft2(flat[1])
    strength = np.abs(cross)
    if not strength.max() > 0:  # one of them is even
        return np.eye(3)
    correlation = np.fft.irfft2(cross / (strength + 1e-3 * strength.max()), s=a.shape)
    dy, dx = (int(v) for v in np.unravel_index(int(np.argmax(correlation)), a.shape))
    dy, dx = dy - a.shape[0] * (dy > a.shape[0] // 2), dx - a.shape[1] * (dx > a.shape[1] // 2)
    if correlation[dy, dx] < 1.5 * correlation[0, 0]:
        dy = dx = 0
    return np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])


def _choose(a: Floats, usable: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Corners (T, 2) = (row, column) of the tiles with most detail, spread over the picture."""
    rows, columns = (a.shape[0] - 2) // TILE, (a.shape[1] - 2) // TILE
    if rows < 1 or columns < 1:
        return np.zeros((0, 2), np.int64)
    cut, size = (slice(0, rows * TILE), slice(0, columns * TILE)), (columns, rows)
    score = np.empty((rows, columns), np.float32)
    for n in range(rows):  # a row of tiles stays in a core's cache
        top = TILE * n
        around = slice(max(top - 1, 0), top + TILE + 1)
        detail = edges(a[around])[top - around.start :][:TILE, cut[1]] * usable[top : top + TILE, cut[1]]
        score[n] = cv2.resize(detail, (columns, 1), interpolation=cv2.INTER_AREA)
    score *= cv2.resize(usable[cut].view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) > 0.7 * 255
    found = []
    for cell_rows in np.array_split(np.arange(rows), min(_CELLS, rows)):
        for cell_columns in np.array_split(np.arange(columns), min(_CELLS, columns)):
            cell = score[np.ix_(cell_rows, cell_columns)]
            for k in np.argsort(cell, axis=None)[::-1][:_PER_CELL]:
                i, j = np.unravel_index(k, cell.shape)
                if cell[i, j] > 0:
                    found.append((TILE * cell_rows[i], TILE * cell_columns[j]))
    return np.array(found, np.int64).reshape(-1, 2)


def _match(a: Floats, b: Floats, ok_b: NDArray[np.bool_], corner: NDArray[np.int64], matrix: Floats) -> _Matches:
    """One Gauss-Newton step for every tile."""
    some = [_match_some(a, b, ok_b, part, matrix) for part in np.split(corner, range(_AT_ONCE, len(corner), _AT_ONCE))]
    return _Matches(
        np.concatenate([one.point for one in some]),
        np.concatenate([one.shift for one in some]),
        np.concatenate([one.information for one in some]),
    )


def _match_some(a: Floats, b: Floats, ok_b: NDArray[np.bool_], corner: NDArray[np.int64], matrix: Floats) -> _Matches:
    """The same for some tiles at once."""
    nothing = _Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    if not len(corner):
        return nothing
    center = corner[:, ::-1] + (TILE - 1) / 2  # x, y
    shift = apply(matrix, center) - center
    whole = np.floor(shift).astype(np.int64)
    first = corner + whole[:, ::-1]
    margin = 2
    inside = np.all((first >= margin) & (first + TILE + margin < np.array(a.shape)), axis=1)
    inside &= np.all((corner >= 1) & (corner + TILE + 1 < np.array(a.shape)), axis=1)
    inside[inside] = _cut(ok_b, first[inside], TILE).mean(axis=(1, 2)) > 0.6
    if not inside.any():
        return nothing
    corner, first, center = corner[inside], first[inside], center[inside]
    patch = _cut(a, corner - 1, TILE + 2)  # (T, TILE + 2, TILE + 2)
    fraction = np.asarray(shift - whole, np.float64)[inside]
    other = _sample(_cut(b, first - 1, TILE + 3), fraction)  # cubic: 1 before, 2 after
    usable = _cut(ok_b, first, TILE)
    inner = patch[:, 1:-1, 1:-1]
    gx = (patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]) / 2
    gy = (patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]) / 2
    basis = np.stack([gx, gy, other, usable], axis=1).reshape(len(corner), 4, -1) * usable.reshape(len(corner), 1, -1)
    normal = basis @ basis.transpose(0, 2, 1)  # unknowns: shift, gain, offset
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    target = inner.reshape(len(corner), -1, 1) * usable.reshape(len(corner), -1, 1)
    solution = np.linalg.solve(normal, basis @ target)[..., 0]
    residual = target[..., 0] - (solution[:, None] @ basis)[:, 0]
    count = usable.sum(axis=(1, 2))
    variance = (residual**2).sum(axis=1) / np.maximum(count - 4, 1) + 1e-12
    # reference(x) = gain · other(x + s + δ) ≈ gain · (seen + ∇ · δ): the first two unknowns are δ; their own
    # normal matrix, gain and offset eliminated, is that of the scene's gradients plus that of the noise's
    both = np.linalg.inv(np.linalg.inv(normal)[:, :2, :2])
    power, axes = np.linalg.eigh(both)
    scene = power - 0.5 * (count * variance)[:, None]
    share = np.where(scene > 0.5 * power, scene, 0)
    along = np.einsum("tik,ti->tk", axes, solution[:, :2]) * power / np.maximum(scene, 0.5 * power)
    missing = np.einsum("tik,tk->ti", axes, np.where(share > 0, along, 0))
    information = np.einsum("tik,tk,tjk->tij", axes, share / variance[:, None], axes)
    good = np.all(np.abs(missing) < _REACH, axis=1) & np.any(share > 0, axis=1)
    good &= (solution[:, 2] > 0.2) & (solution[:, 2] < 5)
    return _Matches(center[good], missing[good], information[good])


def _cut(picture: Floats | NDArray[np.bool_], corner: NDArray[np.int64], size: int) -> Floats:
    windows = np.lib.stride_tricks.sliding_window_view(picture, (size, size))
    return np.asarray(windows[corner[:, 0], corner[:, 1]], np.float64)


def _sample(patch: Floats, fraction: Floats) -> Floats:
    """Catmull-Rom interpolation of whole tiles at one (x, y) fraction each."""
    return np.asarray(_bands(fraction[:, 1]) @ patch @ _bands(fraction[:, 0]).transpose(0, 2, 1))


def _bands(f: Floats) -> Floats:
    """Weights (T, TILE, TILE + 3) of the samples of lines that begin a sample early, at fractions (T,)."""
    weights = (
        ((-f + 2) * f - 1) * f / 2,
        ((3 * f - 5) * f * f + 2) / 2,
        ((-3 * f + 4) * f + 1) * f / 2,
        (f - 1) * f * f / 2,
    )
    out = np.zeros((len(f), TILE, TILE + 3))
    each = np.arange(TILE)
    for k, weight in enumerate(weights):
        out[:, each, each + k] = weight[:, None]
    return out


def _design(u: Floats) -> Floats:
    """Displacement per parameter at normalised points u (T, 2), (T, 2, 8): shift, similarity, homography."""
    x, y = u[:, 0], u[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    dx = [one, zero, x, -y, x, y, x * x, x * y]
    dy = [zero, one, y, x, -y, x, x * y, y * y]
    return np.stack([np.stack(dx, -1), np.stack(dy, -1)], axis=1)


def _fit(matches: _Matches, shape: tuple[int, ...]) -> tuple[Floats, float]:
    """The simplest motion that explains the tiles' shifts, as a homography, and its typical 1σ."""
    h, w = shape
    scale = max(h, w) / 2
    offset = np.array([(w - 1) / 2, (h - 1) / 2])
    design = _design((matches.point - offset) / scale)
    # tiles of rich detail are sure of more than any tile can know: 0.02 px of interpolation and aliasing
    power, axes = np.linalg.eigh(matches.information)
    information = np.einsum("tik,tk,tjk->tij", axes, 1 / (1 / np.maximum(power, 1e-9) + 0.02**2), axes)
    best = None
    spread = 0.0
    for k in (8, 4, 2):
        if 2 * len(matches.point) < 2 * k:
            continue
        parameters, covariance, chi, weight = _robust(design[..., :k], matches.shift, information)
        if not spread:  # the richest model tells how far the tiles' own errors are off
            spread = max(1.0, chi / max(2 * float(weight.sum()) - k, 1.0))
        cost = chi / spread + k * np.log(2 * len(matches.point))
        if best is None or cost < best[0]:
            best = (cost, parameters, covariance * spread, k)
    assert best is not None
    _, parameters, covariance, k = best
    p = np.zeros(8)
    p[:k] = parameters
    generator = np.array(
        [
            [1 + (p[2] + p[4]) / scale, (-p[3] + p[5]) / scale, p[0]],
            [(p[3] + p[5]) / scale, 1 + (p[2] - p[4]) / scale, p[1]],
            [-p[6] / scale**2, -p[7] / scale**2, 1],
        ]
    )
    middle = np.array([[1, 0, offset[0]], [0, 1, offset[1]], [0, 0, 1.0]])
    flow = middle @ generator @ np.linalg.inv(middle)
    each = np.einsum("tik,kl,til->t", design[..., :k], covariance, design[..., :k])
    return flow, float(np.sqrt(each.mean()))


def _robust(design: Floats, shift: Floats, information: Floats) -> tuple[Floats, Floats, float, Floats]:
    """Least squares reweighted by Tukey's biweight; parameters, covariance, χ², weights."""
    weight = np.ones(len(shift))
    k = design.shape[2]
    parameters: Floats = np.zeros(k)
    covariance: Floats = np.eye(k)
    chi2 = np.zeros(len(shift))
    informed = information @ design  # (T, 2, k)
    for _ in range(10):
        weighted = (weight[:, None, None] * informed).reshape(-1, k).T
        normal, right = weighted @ design.reshape(-1, k), weighted @ shift.ravel()
        # what the tiles hardly see (directions known to worse than 0.1 px) hardly moves
        parameters = np.linalg.solve(normal + 100 * np.eye(k), right)
        covariance = np.linalg.inv(normal + np.eye(k))
        rest = shift - design @ parameters
        chi2 = np.einsum("ti,tij,tj->t", rest, information, rest)
        scale = max(float(np.median(chi2)) / 1.386, 1e-6)  # χ² of two has median 1.386
        weight = np.clip(1 - chi2 / (25 * scale), 0, None) ** 2
    return parameters, covariance, float(np.sum(weight * chi2)), weight
