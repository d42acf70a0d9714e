"""In: four or more shots of known gains and the outline. Out: the polarizer's angles, which nobody noted.

Shots at angles θ are I = A(θ) S, of rank three. Another A′ = A B explains them as well if its rows are (1, cos, sin)
too: points on the unit circle that an affine map takes from one another. Through five points goes one ellipse, so five
shots fix θ up to a common turn and the way round; four leave a family of one parameter more. (With gains unknown B
may be any map of the light cone, and far more is free.) The outline tells the rest: body light there is polarized
along the contour's normal φ, so I lies between 1 and cos 2(φ − θ) for every part of it.

Both are asked at once: the outline by parts of equal φ, whose sums obey the same law, and the inside by what leaves
the space that A(θ) spans, each by its own scatter. The doubt is the scatter of the outline's sides and of the inside's
parts (jackknife), how far the answer moves when the outline is believed more or less, and starts that end as well
elsewhere. A common turn that is left over is found by the slopes inside (`ring_by_slopes`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics.outline import SECTORS, Rim

_BINS = 36  # of φ, 10° each
_LEAST_BINS = 24  # with light in them; fewer sides do not tell turn and way round
_STARTS = 20  # drawn at random, the same every time
_COARSE, _FINE = 1e-3, 1e-7  # relative change of the misfit at which the search ends: of all starts, of the best
_POLISHED = 4  # of the starts, the best ones
_AS_GOOD = 1.3  # of the least misfit: angles that end there are possible too
_LAW = 0.012  # relative, of the outline's light: what its parts leave that are no ideal body's
_OTHER_LAWS = (0.004, 0.03)  # that it may be as well: parts of an outline are off by up to 3 %
_PARTS = 8  # of the outline and of the inside, left out one at a time
_INSIDE = 0.0001  # the same of the inside: interpolation and gains
_FLOOR = np.radians(0.3)  # 1σ; where all sides agree (200 simulated cases)


@dataclass(frozen=True)
class Angles:
    """Where the polarizer stood."""

    angle: Floats  # (K,) rad, in 0…π
    sigma: float  # rad, 1σ of each; π/2 where nothing is known


def measure(rim: Rim, cells: Floats, row: NDArray[np.int_], shots: int) -> Angles:
    """The angles that outline and inside ask for.

    Parameters
    ----------
    rim
        The band inside the outline, gains taken out.
    cells
        (K, P) means of small blocks of the inside, gains taken out.
    row
        (P,) where they lie; neighbors share what is wrong with them.
    shots
        K, four or more.
    """
    unknown = Angles(np.zeros(shots), np.pi / 2)
    around, part = _by_direction(rim)
    lit = around.min(axis=1) > 0
    if lit.sum() < _LEAST_BINS or cells.shape[1] < 10 * shots:
        return unknown
    around, part = around[lit], part[lit]
    inside = _condensed(cells)
    ends = [_solved(around, part, inside, start, _COARSE) for start in _starts(shots)]
    ends.sort(key=lambda end: end[0])
    best = _best([_solved(around, part, inside, one, _FINE) for _, one in ends[:_POLISHED]])
    if not best:
        return unknown
    angle = best[0][1]
    others = [one for cost, one in best[1:] if cost < _AS_GOOD * best[0][0]]
    elsewhere = max((float(np.abs(_apart(one, angle)).max()) for one in others), default=0.0)
    sides = np.arange(len(part)) * _PARTS // len(part)
    places = np.argsort(np.argsort(row, kind="stable")) * _PARTS // len(row)
    by_side = [_solved(around[sides != s], part[sides != s], inside, angle, _FINE)[1] for s in range(_PARTS)]
    by_place = [_solved(around, part, _condensed(cells[:, places != s]), angle, _FINE)[1] for s in range(_PARTS)]
    by_law = [_solved(around, part, inside, angle, _FINE, law)[1] for law in _OTHER_LAWS]
    variance = sum((_PARTS - 1) / _PARTS * _squared(each, angle) for each in (by_side, by_place))
    variance = variance + _squared(by_law, angle) / len(by_law)
    return Angles(angle % np.pi, min(float(np.sqrt(_FLOOR**2 + variance.max() + elsewhere**2)), np.pi / 2))


def _squared(each: list[Floats], angle: Floats) -> Floats:
    """Σ of squared distances of each from the angles (K,), rad²."""
    return np.asarray((np.array([_apart(one, angle) for one in each]) ** 2).sum(axis=0))


def _by_direction(rim: Rim) -> tuple[Floats, Floats]:
    """Light of the outline summed where it looks one way, (B, K), and those ways (B,) rad."""
    number = np.floor(rim.azimuth / (2 * np.pi) * _BINS).astype(int) % _BINS
    light = np.stack([np.bincount(number, shot, _BINS) for shot in rim.light], axis=1).astype(np.float64)
    weight = rim.light.sum(axis=0)
    sums = [np.bincount(number, weight * wave, _BINS) for wave in (np.cos(rim.azimuth), np.sin(rim.azimuth))]
    return light.astype(np.float64), np.arctan2(sums[1], sums[0])


def _condensed(cells: Floats) -> Floats:
    """(K, K) whose columns are to the span of A what all cells (K, P) are, each relative to its light.

    Less their mean, which errors of the gains act upon.
    """
    relative = cells / cells.mean(axis=0)
    relative = relative - relative.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(relative @ relative.T / relative.shape[1])
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def _starts(shots: int) -> list[Floats]:
    random = np.random.default_rng(SECTORS)
    return [random.uniform(0, np.pi, shots) for _ in range(_STARTS)]


def _best(ends: list[tuple[float, Floats]]) -> list[tuple[float, Floats]]:
    """Misfits and angles, the best first, each once."""
    found: list[tuple[float, Floats]] = []
    for cost, angle in sorted(ends, key=lambda end: end[0]):
        if np.isfinite(cost) and all(np.abs(_apart(angle, known)).max() > np.radians(0.2) for _, known in found):
            found.append((cost, angle))
    return found


def _solved(
    around: Floats, part: Floats, inside: Floats, start: Floats, until: float, law: float = _LAW
) -> tuple[float, Floats]:
    """Misfit and angles (K,) of least squares from a start; of the two by 90° apart the one of body light."""
    relative = around / around.mean(axis=1, keepdims=True)
    from scipy.optimize import least_squares  # here: importing it costs .3 s of every start

    end = least_squares(_residual, start, args=(relative, part, inside, law), method="lm", ftol=until, max_nfev=150)
    along = np.cos(2 * (part[:, None] - end.x))
    along -= along.mean(axis=1, keepdims=True)
    angle = end.x if float((along * relative).sum()) > 0 else end.x + np.pi / 2
    return float(end.cost), np.asarray(angle)


def _residual(angle: Floats, relative: Floats, part: Floats, inside: Floats, law: float) -> Floats:
    """What of the outline's light lies outside 1 and cos 2(φ − θ), and of the inside's outside A(θ), over their 1σ."""
    ones = np.ones(len(angle)) / np.sqrt(len(angle))
    wave = np.cos(2 * (part[:, None] - angle))
    wave = wave - (wave @ ones)[:, None] * ones
    wave = wave / np.maximum(np.linalg.norm(wave, axis=1, keepdims=True), 1e-9)
    left = relative - (relative @ ones)[:, None] * ones
    left = left - (left * wave).sum(axis=1, keepdims=True) * wave
    rows = np.stack([np.ones_like(angle), np.cos(2 * angle), np.sin(2 * angle)], axis=1)
    basis, _ = np.linalg.qr(rows)
    out = inside - basis @ (basis.T @ inside)
    return np.concatenate([left.ravel() / law / np.sqrt(len(part)), out.ravel() / _INSIDE])


def _apart(a: Floats, b: Floats) -> Floats:
    """From b to a, axes, −π/2…π/2."""
    return np.asarray((a - b + np.pi / 2) % np.pi - np.pi / 2)
