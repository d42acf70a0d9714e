"""Whether more than three shots close, and if not, by which shot's angle: a check of single angles by all pixels.

K > 3 shots of gains g lie in a space of three dimensions: with N spanning what A = ½ (1, cos 2θ, sin 2θ) leaves free,
N·(I/g) = 0. A shot k turned by δ leaves N_k δ dI_k/dθ, which goes with the polarization; a gain that is off by ε
leaves N_j ε I_j, which goes with the light. Where gains are only guessed, the two can stand for one another, so what
is known of gains enters as it is doubted.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import mueller
from polcap.optics.robust import BIWEIGHT, MAD_TO_SIGMA

_PARTS = 12  # of the object, whose scatter is the doubt
_LEAST_CELLS = 60
_LEAST_GAIN = 0.5  # of the misfit with the stated angles, to be believed; 15° takes 0.8 or more, good captures < 0.3
_LEAST_SIGMAS = 3.5
_ALIKE = 0.9  # of the best shot's gain in misfit: then which of them was turned cannot be seen
_FAR = np.radians(np.arange(20.0, 91.0, 5.0))  # turns that no tangent reaches: a ring that was not turned at all
_MOST_LEFT = 0.25  # of the median residual with the angles as stated, for such a turn to be started from
_ANGLE_ERROR = np.radians(0.5)  # 1σ of every angle, set by hand or motor, against its mark


@dataclass(frozen=True)
class Turn:
    """The turn of one shot that lets all of them close."""

    shots: tuple[int, ...]  # the likeliest; of several that cannot be told apart the most turned first; none: all close
    angle: float  # rad, true minus stated, of the first of them
    sigma: float  # rad


NONE = Turn((), 0.0, np.pi / 2)


def measure(light: Floats, row: NDArray[np.int_], angle: Floats, gain_sigma: Floats) -> Turn:
    """The single turn that the shots ask for beyond its doubt; `NONE` for three shots, or too little to see.

    Parameters
    ----------
    light
        (K, P) means of small cells of the object, gains taken out.
    row
        (P,) of each cell; neighbours fall into the same part.
    angle
        (K,) rad, as stated.
    gain_sigma
        (K,) 1σ of each gain.
    """
    shots = len(angle)
    if shots < 4 or light.shape[1] < _LEAST_CELLS:
        return NONE
    light = light / light.mean(0)
    part = np.searchsorted(np.quantile(row, np.linspace(0, 1, _PARTS + 1)[1:-1]), row)
    prior = np.diag(1 / np.maximum(gain_sigma, 1e-4) ** 2)
    fits = [_turned(k, 0.0, light, angle, part, prior) for k in range(shots)]
    for k, start in _far_turns(light, angle):
        further = _turned(k, start, light, angle, part, prior)
        left = further.stated - further.gained
        if left < fits[k].stated - fits[k].gained:
            fits[k] = replace(further, stated=fits[k].stated, gained=fits[k].stated - left)
    most = max(fit.gained for fit in fits)
    alike = [k for k in range(shots) if fits[k].gained >= _ALIKE * most]
    alike.sort(key=lambda k: -abs(fits[k].turn))  # a small turn of one shot can be a large one of another
    found = fits[alike[0]]
    told = _told(light, angle)  # an error of one angle is a greater one of another that the closure tells less of
    by_angles = _ANGLE_ERROR * float(np.linalg.norm(told) / max(told[alike[0]], 1e-9))
    sigma = float(np.hypot(found.sigma, by_angles))
    if found.gained < _LEAST_GAIN * found.stated or abs(found.turn) < _LEAST_SIGMAS * sigma:
        return NONE
    return Turn(tuple(alike), found.turn, sigma)


@dataclass(frozen=True)
class _Fit:
    turn: float  # rad
    sigma: float  # rad
    stated: float  # misfit with the angles as stated
    gained: float  # of it by the turn


def _far_turns(light: Floats, angle: Floats) -> list[tuple[int, float]]:
    """Great turns (shot, rad) after which next to nothing is left of what keeps the shots from closing."""
    shots = range(len(angle))
    stated = _median_left(light, angle)
    found = []
    for k in shots:
        turns = [float(way * size) for size in _FAR for way in (-1, 1)]
        left, best = min((_median_left(light, angle + turn * np.eye(len(angle))[k]), turn) for turn in turns)
        if left < _MOST_LEFT * stated:
            found.append((k, best))
    return found


def _median_left(light: Floats, angle: Floats) -> float:
    return float(np.median(np.linalg.norm(_free(angle) @ light, axis=0)))


def _free(angle: Floats) -> Floats:
    """(K − 3, K) what no light gives to shots at these angles."""
    return np.asarray(np.linalg.svd(mueller.analyzer(angle))[0][:, 3:].T)


def _told(light: Floats, angle: Floats) -> Floats:
    """(K,) how much of what keeps the shots from closing a small turn of each is, per rad."""
    return np.asarray(np.linalg.norm(_free(angle), axis=0) * np.sqrt((_slope(light, angle) ** 2).mean(axis=1)))


def _slope(light: Floats, angle: Floats) -> Floats:
    """dI/dθ of every shot, (K, P)."""
    _, s1, s2 = np.linalg.lstsq(mueller.analyzer(angle), light, rcond=None)[0]
    return np.asarray(s2 * np.cos(2 * angle[:, None]) - s1 * np.sin(2 * angle[:, None]))


def _turned(k: int, start: float, light: Floats, angle: Floats, part: NDArray[np.intp], prior: Floats) -> _Fit:
    """Shot k turned by `start`, and what more the shots ask for."""
    angle = angle + start * np.eye(len(angle))[k]
    free = _free(angle)
    slope = _slope(light, angle)[k]
    fit = _fit(free @ light, free[:, None] * light.T, free[:, k, None] * slope, part, prior)
    return replace(fit, turn=start + fit.turn)


def _fit(left: Floats, by_gain: Floats, by_turn: Floats, part: NDArray[np.intp], prior: Floats) -> _Fit:
    """Gains and one turn by least squares, (K − 3, P) residuals over what each leaves; parts stand for measurements."""
    size = by_gain.shape[2] + 1
    columns = np.concatenate([by_gain, by_turn[..., None]], axis=2)  # (K − 3, P, K + 1)
    trust = np.ones(left.shape[1])
    for _ in range(4):  # moved edges and highlights close with no angle
        weighted = columns * trust[:, None]
        square = np.einsum("npi,npj->ij", weighted, columns, optimize=True)
        right = np.einsum("npi,np->i", weighted, left)
        noise = float((trust * (left**2).sum(0)).sum() / max(trust.sum(), 1e-9))
        scaled = np.zeros((size, size))
        scaled[:-1, :-1] = prior * noise
        found = np.linalg.solve(square + scaled + 1e-12 * np.eye(size), right)
        off = np.linalg.norm(left - columns @ found, axis=0)
        spread = MAD_TO_SIGMA * float(np.median(off)) + 1e-9
        trust = np.maximum(0, 1 - (off / (BIWEIGHT * spread)) ** 2) ** 2
    total = float((trust * (left**2).sum(0)).sum())
    gains_alone = np.linalg.solve(square[:-1, :-1] + scaled[:-1, :-1] + 1e-12 * np.eye(size - 1), right[:-1])
    stated = total - float(right[:-1] @ gains_alone)
    after = total - float(right @ found)
    estimates = []
    for p in np.unique(part):
        kept = part != p
        some = np.einsum("npi,npj->ij", weighted[:, kept], columns[:, kept], optimize=True) + scaled
        towards = np.einsum("npi,np->i", weighted[:, kept], left[:, kept])
        estimates.append(np.linalg.solve(some + 1e-12 * np.eye(size), towards)[-1])
    count = len(estimates)
    sigma = float(np.sqrt((count - 1) / count * np.sum((np.array(estimates) - np.mean(estimates)) ** 2)))
    doubt = float(np.sqrt(noise * np.linalg.inv(square + scaled + 1e-12 * np.eye(size))[-1, -1]))
    return _Fit(float(found[-1]), float(np.hypot(sigma, doubt)), stated, stated - after)
