"""By how much the zero of the polarizer ring is off, told by the inside: slopes there are those of a height.

What `integrability` asks of the gains, Im(w_ζ² w*) = 0, holds for one common turn of the angles only: a ring that is
off by δ turns w_ζ² w* by 2δ at every pixel. Limbs, edges and highlights are outliers, and neither outline nor
symmetry is needed, so an object of many thin parts tells as much as a ball. The gains, which act where a surface faces
the camera, are solved for as well, held by what is known of them (decision 26).
"""

import numpy as np

from polcap.images import Floats
from polcap.stages.selfcal import integrability
from polcap.stages.selfcal.integrability import Slopes
from polcap.stages.selfcal.object_gains import Bools
from polcap.stages.selfcal.ring_zero import UNKNOWN, RingZero

_STEEPEST = 9.0  # tan²θ of the pixels that count; beyond, the law of the body is another
_ROUNDS = 12
_SETTLED = 1e-5  # change that ends them
_MOST_STEP = 0.1  # rad, and of a gain, in one go
_CORRELATED = 2 * np.pi * integrability.BLUR**2  # px that share their noise
_FLOOR = np.radians(0.1)  # 1σ where all parts agree (decision 26)


def measure(light: Floats, usable: Bools, angle: Floats, gain_sigma: float) -> RingZero:
    """The ring's error, of registered shots without their gains.

    Parameters
    ----------
    light
        (K, H, W) shots, little blurred.
    usable
        (H, W) pixels of the object that can be believed.
    angle
        (K,) rad, as stated.
    gain_sigma
        1σ of the shots' gains, relative.
    """
    slopes = integrability.seen(light, usable, angle)
    if slopes is None:
        return UNKNOWN
    start: Floats = np.append(np.ones(len(angle) - 1), 0.0)
    unknowns = start
    for _ in range(_ROUNDS):
        residual, rows, trust, product = integrability.linearized(slopes, unknowns, _STEEPEST)
        trust = trust * (product.real > 0)
        step = _step(rows, residual, trust, unknowns - start, gain_sigma)
        unknowns = unknowns + np.clip(step, -_MOST_STEP, _MOST_STEP)
        if np.abs(step).max() < _SETTLED:
            break
    if not _one_surface(slopes, unknowns):
        return UNKNOWN
    part = integrability.part_of(slopes.inside)
    without = np.array(
        [_step(rows, residual, trust * (part != p), unknowns - start, gain_sigma)[-1] for p in np.unique(part)]
    )
    scatter = (len(without) - 1) / len(without) * float(((without - without.mean()) ** 2).sum())
    return RingZero(-float(unknowns[-1]), min(float(np.sqrt(scatter + _FLOOR**2)), np.pi / 2))


def _step(rows: Floats, residual: Floats, trust: Floats, gone: Floats, gain_sigma: float) -> Floats:
    """The step (K,) of gains and turn that leaves least of the residuals (N,); gains `gone` from 1 are held by σ."""
    noise = float((trust * residual**2).sum() / max(float(trust.sum()), 1e-9))
    held = np.append(np.full(len(gone) - 1, 1 / max(gain_sigma, 1e-4) ** 2), 0.0) * noise * _CORRELATED
    square = rows.T @ (rows * trust[:, None]) + np.diag(held)
    damped = square + (1e-9 * np.trace(square) + 1e-12) * np.eye(len(square))
    return np.asarray(np.linalg.solve(damped, -rows.T @ (residual * trust) - held * gone))


def _one_surface(slopes: Slopes, unknowns: Floats) -> bool:
    """Whether w_ζ² w* is positive for most of the light, as a body's is; a reflection's is negative."""
    _, _, trust, product = integrability.linearized(slopes, unknowns, _STEEPEST)
    return float((trust * product.real).sum()) > integrability.COHERENT * float((trust * np.abs(product)).sum())


def joined(one: RingZero, other: RingZero) -> RingZero:
    """What two measurements of one ring say together; where they contradict one another the doubt is their distance."""
    weight = one.sigma**-2, other.sigma**-2
    turn = (weight[0] * one.turn + weight[1] * other.turn) / sum(weight)
    apart = abs(one.turn - other.turn) / float(np.hypot(one.sigma, other.sigma))
    return RingZero(turn, min(max(1.0, apart) / float(np.sqrt(sum(weight))), np.pi / 2))
