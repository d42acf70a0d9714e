"""Whether the object's outline supports the order and sense of the angles as stated, or others clearly better.

Orders that give the same analyzers are one: (0°, 120°, 60°) counted clockwise is (0°, 60°, 120°). A common turn of
all angles is no other order. What is left is compared by what it predicts: AoLP across the contour all round, and,
with more than three shots, intensities that lie in the space of S0, S1, S2. Ties go to what was stated.
"""

from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import mueller, outline
from polcap.optics.outline import Rim

Bools = NDArray[np.bool_]
Order = tuple[tuple[int, ...], bool]  # which stated angle each shot has, and whether they count clockwise

_MOST_PERMUTED = 4  # beyond, only exchanges of two shots, and the reversal, are tried
_CLOSES = 3.0  # factor on the misfit of more than three shots that rules an order out, or in; set by hand
_APART = 2.0  # σ that the stated order must be ahead of another for the outline to tell the two apart
_LEAST_RIVAL = 0.25  # score of an order that the object could have as well: half of chance's greatest; set by hand
_ROUGH = 0.01  # misfit that gains and interpolation leave at most, relative to the light: a flash repeats within 1 %


@dataclass(frozen=True)
class Verdict:
    """What the outline says of the angles."""

    order: Order  # the one that fits best beyond the doubt; else as stated
    score: float  # of the stated order: mean of w cos 2(φ − φ_contour)
    best_score: float
    doubt: float  # 1σ of the difference of the two
    concentration: float  # 0…1, of the AoLP about the turned outline
    rival: Order | None = None  # another order that fits as well as far as can be seen


def rim(value: Floats, usable: Bools, mask: Bools, crop: tuple[int, int, int, int], full: tuple[int, ...]) -> Rim:
    """The rim of the object; where it leaves the picture its outline is no contour of shape.

    Parameters
    ----------
    value
        (K, H, W) registered shots on the crop, gains taken out.
    usable
        (H, W) pixels to be believed.
    mask
        (H, W).
    crop
        x0, y0, x1, y1 of the crop on the reference grid, px.
    full
        (H, W) of that grid.
    """
    depth = outline.depth(mask)
    out, slope = outline.outward(mask.astype(np.float32), 3.0)
    band = (depth > 1.5) & (depth < max(5.0, 0.02 * max(mask.shape))) & (slope > 1e-4) & usable
    x0, y0, x1, y1 = crop
    edge = 3
    band[: max(0, edge - y0)] = False
    band[:, : max(0, edge - x0)] = False
    band[mask.shape[0] - max(0, y1 - (full[0] - edge)) :] = False
    band[:, mask.shape[1] - max(0, x1 - (full[1] - edge)) :] = False
    return Rim(np.asarray(value[:, band], np.float64), np.arctan2(out[1], out[0])[band], outline.sectors(band))


def judge(at: Rim, angle: Floats, margin: float, believable: float, beyond_sigma: float = 3.0) -> Verdict:
    """What the rim says of the order and sense of the angles.

    Parameters
    ----------
    at
        The rim.
    angle
        (K,) rad, as stated.
    margin
        How much better another order must fit, of a score −1…1.
    believable
        Least score of another order.
    beyond_sigma
        σ of the difference of the two scores that it must exceed as well.
    """
    stated: Order = (tuple(range(len(angle))), False)
    if at.light.shape[1] == 0:
        return Verdict(stated, 0.0, 0.0, 1.0, 0.0)
    total, weight = outline.phasor(at, angle)
    mean, _ = outline.mean_and_doubt(total, weight)
    here = _misfit(at, angle)
    best, best_score, doubt = stated, abs(mean), 0.0
    rival: Order | None = None
    nearest = -np.inf
    for order, turned in hypotheses(angle).items():
        misfit = _misfit(at, turned)
        if order == stated or misfit > _CLOSES * here:
            continue
        least = 0.0 if _CLOSES * misfit < here > _ROUGH else margin  # more than three shots agree in this order alone
        other, others = outline.phasor(at, turned)
        score = float(other.sum().real / max(others.sum(), 1e-9))
        sigma = _jackknife(other.real, others, (total * np.exp(-1j * np.angle(mean))).real, weight)
        if score > _LEAST_RIVAL and least and score - abs(mean) > max(nearest, -_APART * sigma):
            rival, nearest = order, score - abs(mean)
        needed = max(least, beyond_sigma * sigma * (least > 0))
        if score > max(best_score, believable) and score - abs(mean) > needed:
            best, best_score, doubt = order, score, sigma
    return Verdict(best, mean.real, best_score, doubt, abs(mean), rival)


def hypotheses(angle: Floats) -> dict[Order, Floats]:
    """Angles (K,) rad of every order and sense that gives analyzers of its own; the stated one first."""
    shots = len(angle)
    nominal = tuple(range(shots))
    orders = list(permutations(nominal)) if shots <= _MOST_PERMUTED else [nominal, *_exchanged(shots), nominal[::-1]]
    found: dict[Order, Floats] = {}
    for order in sorted(set(orders), key=lambda one: (one != nominal, one)):
        for mirrored in (False, True):
            turned = angle[list(order)] * (-1 if mirrored else 1)
            weights = mueller.analyzer(turned)
            if all(np.abs(weights - mueller.analyzer(known)).max() > 0.02 for known in found.values()):
                found[order, mirrored] = turned
    return found


def _exchanged(shots: int) -> list[tuple[int, ...]]:
    """Every exchange of two of the shots."""
    found = []
    for i, j in combinations(range(shots), 2):
        order = list(range(shots))
        order[i], order[j] = j, i
        found.append(tuple(order))
    return found


def _misfit(at: Rim, angle: Floats) -> float:
    """Median relative residual of more than three shots; the noise of a fit that cannot fail is 1."""
    if len(angle) < 4:
        return 1.0
    weights = mueller.analyzer(angle)
    stokes = np.linalg.lstsq(weights, at.light, rcond=None)[0]
    residual = np.linalg.norm(at.light - weights @ stokes, axis=0) / np.maximum(at.light.sum(0), 1e-9)
    return float(np.median(residual)) + 1e-4


def _jackknife(one: Floats, one_weight: Floats, other: Floats, other_weight: Floats) -> float:
    """1σ of Σone/Σone_weight − Σother/Σother_weight from leaving sectors out, (24,) each; 1 where nothing tells it."""
    used = np.flatnonzero(one_weight + other_weight)
    if len(used) < 2:
        return 1.0
    without = np.array(
        [
            (one.sum() - one[s]) / max(one_weight.sum() - one_weight[s], 1e-9)
            - (other.sum() - other[s]) / max(other_weight.sum() - other_weight[s], 1e-9)
            for s in used
        ]
    )
    return float(np.sqrt((len(used) - 1) / len(used) * ((without - without.mean()) ** 2).sum()))
