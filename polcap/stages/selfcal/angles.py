"""Checks the stated polarizer angles: order, sense, one turned shot.

Order and sense are checked at the outline, where diffuse reflection is polarized across the contour. Orders with the
same analyzers are the same order: (0°, 120°, 60°) clockwise is (0°, 60°, 120°). A common turn of all angles does not
change the order. If two orders fit equally well, the stated one is taken.

One turned shot is found among K > 3 shots with known gains g. The intensities I of a pixel lie in the three-dimensional
column space of A = ½ (1, cos 2θ, sin 2θ). With N spanning its complement, N·(I/g) = 0. Shot k turned by δ leaves the
residual N_k δ dI_k/dθ, proportional to the polarization. A gain with error ε leaves N_j ε I_j, proportional to the
light. Errors of the gains can imitate a turn, so the gains are fitted too, with their errors as prior.
"""

from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from polcap.capture_values import ShotOrder
from polcap.image_values import Floats
from polcap.optics import mueller, outline
from polcap.optics.outline import OutlineBand
from polcap.optics.robust import biweight, jackknife, spread
from polcap.stage_values import OtherOrder, OutlineCheck, TurnedShot
from polcap.stages.selfcal.object_gains import ObjectShots

# Order and sense.
_EDGE_PX = 3  # from the picture's edge; nearer pixels are not on the object's contour
_MOST_PERMUTED = 4  # shots; with more, only exchanges of two shots and the reversal are tried
_CLOSES = 3.0  # factor of misfit, for K > 3, with which an order is excluded or accepted; set by hand
_EXCLUDED = 2.0  # σ; another order is excluded if the stated one is better by more
_ACCEPTED = 3.0  # σ by which another order must be better to be accepted
_CONCLUSIVE = 0.75  # score above which an outline without a rival order decides (docs/benchmarks/gates.md)
_EQUAL = 0.02  # largest difference of equal analyzers
_LEAST_RIVAL = 0.25  # least score of a rival: another order that may be true too; set by hand
_ROUGH = 0.01  # largest relative misfit by gains and interpolation: a flash repeats within 1 %
# One turned shot.
_PARTS = 12  # of the object; their scatter gives the error
_LEAST_CELLS = 60
_LEAST_REDUCTION = 0.5  # of the misfit by a turn; a shot turned by 15° has 0.8 or more, right angles less than 0.3
_LEAST_SIGMAS = 3.5  # σ; least turn
_ALIKE = 0.9  # of the best shot's reduction of the misfit; shots above cannot be distinguished
_FAR = np.radians(np.arange(20.0, 91.0, 5.0))  # turns beyond the linear fit: a ring that was not turned
_MOST_LEFT = 0.25  # largest residual after a large turn, over that with the stated angles
_ANGLE_ERROR = np.radians(0.5)  # 1σ of each angle, set by hand or motor


def rim(shots: ObjectShots) -> OutlineBand:
    """Band of pixels 1.5 px to 5 px (2 % of a large crop) inside the object's outline, not at the picture's edge."""
    mask, (x0, y0, x1, y1) = shots.mask, shots.crop
    depth = outline.depth(mask)
    outward, slope = outline.outward(mask.astype(np.float32), 3.0)
    band = (depth > 1.5) & (depth < max(5.0, 0.02 * max(mask.shape))) & (slope > 1e-4) & (shots.quality == 0)
    inner = np.zeros(shots.full, bool)
    inner[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] = True
    band &= inner[y0:y1, x0:x1]
    light = np.asarray(shots.light[:, band], np.float64)
    return OutlineBand(light, np.arctan2(outward[1], outward[0])[band], outline.sectors(band))


@dataclass(frozen=True)
class OrderFit:
    """Result of the check of order and sense, with the score −1…1 of the best order."""

    check: OutlineCheck
    best_score: float


def check_order(band: OutlineBand, angle: Floats, margin: float, least_score: float) -> OrderFit:
    """Find the order and sense of the stated polarizer angles (K,) rad that fit the object's outline best.

    Another order must have a score of `least_score` or more, and be better than the stated one by `margin`.
    """
    stated = ShotOrder(tuple(range(len(angle))))
    if band.light.shape[1] == 0:
        return OrderFit(OutlineCheck(stated, 0.0), 0.0)
    total, weight = outline.phasor(band, angle)
    mean, _ = outline.mean_and_sigma(total, weight)
    along = (total * np.exp(-1j * np.angle(mean))).real
    stated_misfit = _misfit(band, angle)
    best, best_score = stated, abs(mean)
    rival, rival_lead = None, -np.inf
    for order, turned in hypotheses(angle).items():
        misfit = _misfit(band, turned)
        if order == stated or misfit > _CLOSES * stated_misfit:
            continue
        only_this_closes = _CLOSES * misfit < stated_misfit and stated_misfit > _ROUGH  # for K > 3
        phasor, phasor_weight = outline.phasor(band, turned)
        score = float(phasor.sum().real / max(phasor_weight.sum(), 1e-9))
        sigma = _sigma_of_difference(phasor.real, phasor_weight, along, weight)
        lead = score - abs(mean)
        if score > _LEAST_RIVAL and not only_this_closes and lead > max(rival_lead, -_EXCLUDED * sigma):
            rival, rival_lead = order, lead
        least_lead = 0.0 if only_this_closes else max(margin, _ACCEPTED * sigma)
        if score > max(best_score, least_score) and lead > least_lead:
            best, best_score = order, score
    return OrderFit(OutlineCheck(best, abs(mean), rival, mean.real), best_score)


def other_orders(check: OutlineCheck, angle: Floats) -> tuple[OtherOrder, ...]:
    """Orders and senses of the polarizer angles (K,) rad that neither the outline nor a redundant shot excludes."""
    if check.rival is None and check.score > _CONCLUSIVE:
        return ()
    light = mueller.analyzer(angle)
    found = []
    for order, turned in list(hypotheses(angle).items())[1:]:
        weights = mueller.analyzer(turned)
        matrix = np.linalg.pinv(weights) @ light
        if np.abs(weights @ matrix - light).max() < _EQUAL:  # always, for three shots
            found.append(OtherOrder(order, matrix))
    return tuple(found)


def hypotheses(angle: Floats) -> dict[ShotOrder, Floats]:
    """Angles (K,) rad of every order and sense with different analyzers; the stated one first."""
    nominal = tuple(range(len(angle)))
    if len(angle) <= _MOST_PERMUTED:
        orders = set(permutations(nominal))
    else:
        exchanged = (tuple({i: j, j: i}.get(k, k) for k in nominal) for i, j in combinations(nominal, 2))
        orders = {nominal, nominal[::-1], *exchanged}
    found: dict[ShotOrder, Floats] = {}
    for order in sorted(orders, key=lambda one: (one != nominal, one)):
        for mirrored in (False, True):
            turned = angle[list(order)] * (-1 if mirrored else 1)
            weights = mueller.analyzer(turned)
            if all(np.abs(weights - mueller.analyzer(other)).max() > _EQUAL for other in found.values()):
                found[ShotOrder(order, mirrored)] = turned
    return found


def _misfit(band: OutlineBand, angle: Floats) -> float:
    """Misfit of the outline's light to polarizer angles (K,): median relative residual; 1 for three shots."""
    if len(angle) < 4:
        return 1.0
    weights = mueller.analyzer(angle)
    stokes = np.linalg.lstsq(weights, band.light, rcond=None)[0]
    residual = np.linalg.norm(band.light - weights @ stokes, axis=0) / np.maximum(band.light.sum(0), 1e-9)
    return float(np.median(residual)) + 1e-4  # never 0, because misfits are compared by their ratio


def _sigma_of_difference(one: Floats, one_weight: Floats, other: Floats, other_weight: Floats) -> float:
    """1σ of the difference of two scores Σone/Σone_weight and Σother/Σother_weight, by jackknife over sectors (24,)."""
    used = np.flatnonzero(one_weight + other_weight)
    if len(used) < 2:
        return 1.0
    without = [
        (part.sum() - part[used]) / np.maximum(weight.sum() - weight[used], 1e-9)
        for part, weight in ((one, one_weight), (other, other_weight))
    ]
    return float(jackknife(without[0] - without[1]))


def turned_shot(light: Floats, row: NDArray[np.int_], angle: Floats, gain_sigma: Floats) -> TurnedShot:
    """Detect one shot, of more than three, with a polarizer angle that contradicts the others.

    light (K, P) are means of P small cells of the object, divided by the gains. row (P,) is the row of each cell;
    neighboring rows form the parts of the jackknife. angle (K,) rad are the stated angles, gain_sigma (K,) is 1σ of the
    gains. The result is empty for three shots or too few cells.
    """
    shots = len(angle)
    if shots < 4 or light.shape[1] < _LEAST_CELLS:
        return TurnedShot()
    light = light / light.mean(0)
    part = np.searchsorted(np.quantile(row, np.linspace(0, 1, _PARTS + 1)[1:-1]), row)
    prior = np.diag(1 / np.maximum(gain_sigma, 1e-4) ** 2)
    fits = []
    for k, shot in enumerate(np.eye(shots)):
        turns = np.concatenate([[0.0], _FAR, -_FAR])
        residual = [_median_residual(light, angle + turn * shot) for turn in turns]
        fit = _fit_turn(k, 0.0, light, angle, part, prior)
        if min(residual) < _MOST_LEFT * residual[0]:
            far = _fit_turn(k, turns[np.argmin(residual)], light, angle, part, prior)
            best = min(fit, far, key=lambda one: one.misfit)
            fit = replace(best, misfit_as_stated=fit.misfit_as_stated)
        fits.append(fit)
    reduction = [fit.misfit_as_stated - fit.misfit for fit in fits]
    alike = [k for k in range(shots) if reduction[k] >= _ALIKE * max(reduction)]
    alike.sort(key=lambda k: -abs(fits[k].turn))  # a small turn of one shot can be a large one of another
    found = fits[alike[0]]
    # An error of one angle has the effect of a larger error of an angle to which the residual is less sensitive.
    change = np.sqrt((_change_per_rad(light, angle) ** 2).mean(axis=1))
    sensitivity = np.linalg.norm(_complement(angle), axis=0) * change
    by_angles = _ANGLE_ERROR * float(np.linalg.norm(sensitivity) / max(sensitivity[alike[0]], 1e-9))
    sigma = float(np.hypot(found.sigma, by_angles))
    if reduction[alike[0]] < _LEAST_REDUCTION * found.misfit_as_stated or abs(found.turn) < _LEAST_SIGMAS * sigma:
        return TurnedShot()
    return TurnedShot(tuple(alike), found.turn, sigma)


@dataclass(frozen=True)
class _TurnFit:
    """Angle error of one shot, fitted together with the gains."""

    turn: float  # rad
    sigma: float  # rad
    misfit_as_stated: float  # with the stated angles and fitted gains
    misfit: float  # with the turn too


def _median_residual(light: Floats, angle: Floats) -> float:
    """Median misfit of light (K, P) to polarizer angles (K,): distance from the column space of A(θ)."""
    return float(np.median(np.linalg.norm(_complement(angle) @ light, axis=0)))


def _complement(angle: Floats) -> Floats:
    """Orthogonal complement N (K − 3, K) of the column space of A(θ), for polarizer angles θ (K,)."""
    return np.asarray(np.linalg.svd(mueller.analyzer(angle))[0][:, 3:].T)


def _change_per_rad(light: Floats, angle: Floats) -> Floats:
    """Derivative dI/dθ (K, P) of the light of each shot by its polarizer angle."""
    _, s1, s2 = np.linalg.lstsq(mueller.analyzer(angle), light, rcond=None)[0]
    return np.asarray(s2 * np.cos(2 * angle[:, None]) - s1 * np.sin(2 * angle[:, None]))


def _fit_turn(k: int, start: float, light: Floats, angle: Floats, part: NDArray[np.intp], prior: Floats) -> _TurnFit:
    """Fit the angle error of shot k [rad], and the gains, from a start, by least squares with biweights."""
    angle = angle + start * np.eye(len(angle))[k]
    complement = _complement(angle)
    residual = complement @ light  # (K − 3, P)
    by_turn = complement[:, k, None] * _change_per_rad(light, angle)[k]
    columns = np.concatenate([complement[:, None] * light.T, by_turn[..., None]], axis=2)  # (K − 3, P, K + 1)
    weight: Floats = np.ones(residual.shape[1])
    ridge = 1e-12 * np.eye(columns.shape[2])

    def equations(weight: Floats, noise: float) -> tuple[Floats, Floats]:
        weighted = columns * weight[:, None]
        square = np.einsum("npi,npj->ij", weighted, columns, optimize=True) + ridge
        square[:-1, :-1] += prior * noise
        return square, np.einsum("npi,np->i", weighted, residual)

    for _ in range(4):  # biweights: moved edges and highlights fit no angle
        noise = float((weight * (residual**2).sum(0)).sum() / max(weight.sum(), 1e-9))
        square, right = equations(weight, noise)
        found, used = np.linalg.solve(square, right), weight
        distance = np.linalg.norm(residual - columns @ found, axis=0)
        weight = biweight(distance, spread(distance))
    total = float((weight * (residual**2).sum(0)).sum())
    stated = total - float(right[:-1] @ np.linalg.solve(square[:-1, :-1], right[:-1]))
    without = [np.linalg.solve(*equations(used * (part != p), noise))[-1] for p in np.unique(part)]
    by_noise = np.sqrt(noise * np.linalg.inv(square)[-1, -1])
    sigma = float(np.hypot(jackknife(np.array(without)), by_noise))
    return _TurnFit(start + float(found[-1]), sigma, stated, total - float(right @ found))
