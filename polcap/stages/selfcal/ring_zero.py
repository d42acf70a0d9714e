"""Zero error of the polarizer's ring, measured from the object's outline and from the slopes inside it.

At the outline: diffuse reflection is polarized along the slope g = tan θ (cos φ, sin φ) of the surface. A slope has no
curl, so along a closed curve with tangent t, ∮ g·t = 0 on any smooth surface. A zero error δ turns g by δ, and then ∮
g·t / ∮ g·n = tan δ, with n pointing out of the curve. The curves are the contours of a blurred mask, at several depths
inside the outline. The DoLP is used in place of tan θ. The law does not hold for occluded parts, sharp edges, mirrored
light and interreflection. Their effects change with the depth, so the spread over depths gives the error (decision 26).

Inside: Im(w_ζ² w*) = 0 (`integrability`) holds for one common turn of the angles only, because an error δ turns w_ζ² w*
by 2δ at every pixel. Occlusions, edges and highlights are outliers. The gains are fitted too, with their error as prior
(decision 26).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import mueller, outline
from polcap.optics.morphology import masked_mean
from polcap.optics.resize import area_mean
from polcap.optics.robust import jackknife
from polcap.stage_values import RingZero
from polcap.stages.selfcal import integrability
from polcap.stages.selfcal.object_gains import weighted_mean

Complexes = NDArray[np.complex128]

UNKNOWN = RingZero(0.0, np.pi / 2)

# By the outline.
_RIM_PX = 3.0  # 1σ of the mask's blur for the outermost contours
_GRID_SIGMA = 8.0  # 1σ of a blur, in px of the coarser grid on which it is computed
_DEEPER = (0.1, 0.2)  # 1σ of blurs with contours deeper inside, in radii of the object
_PLATEAU = 0.3  # radii; the last contours are those of the depth, up to this depth
_SMOOTH_PX = 1.0  # of the light, inside the object only
_LEAST_DEPTH_PX = 1.5  # of a pixel that is used; nearer ones are partly backdrop
_SPREAD_TO_SIGMA = 2.0  # error of the outermost result over its rms difference from the deeper ones (decision 26)
_FLOOR = np.radians(0.25)  # least error (decision 26)
_LEAST_RIM_PX = 200  # pixels of the rim
_ITERATIONS = 4  # of `_turn`
_SIGMA_FACTOR = 1.6  # rms of error over estimated 1σ, of 29 path-traced objects (docs/benchmarks/gains-and-angles.md)
# By the slopes.
_STEEPEST = 9.0  # largest tan²θ of the pixels used
_ROUNDS = 12  # at most
_SETTLED = 1e-5  # a smaller step ends the rounds
_MOST_STEP = 0.1  # largest step, rad or relative gain
_CORRELATED = 2 * np.pi * integrability.BLUR**2  # px with common noise
_SLOPES_FLOOR = np.radians(0.1)  # least 1σ (decision 26)


def combined(one: RingZero, other: RingZero) -> RingZero:
    """Weighted mean of two measurements of a ring's zero; if they contradict, its error grows with the difference."""
    offset, sigma = weighted_mean(np.array([one.offset, other.offset]), np.array([one.sigma, other.sigma]))
    return RingZero(float(offset), min(_SIGMA_FACTOR * float(sigma), np.pi / 2))


def by_outline(
    light: Floats, usable: Bools, mask: Bools, angle: Floats, gain_sigma: float, leaves_picture: bool
) -> RingZero:
    """Error of the polarizer ring's zero, from the outline of registered shots (K, H, W) without their gains.

    usable (H, W) are the pixels without defects, angle (K,) rad the stated angles, gain_sigma the relative 1σ of the
    gains. If the object leaves the picture there is no closed curve, and the result is UNKNOWN.
    """
    margin = int(np.ceil(4 * _RIM_PX))
    light = np.pad(light, ((0, 0), (margin, margin), (margin, margin)))
    usable, mask = np.pad(usable, margin), np.pad(mask, margin)
    depth = outline.depth(mask)
    inside = depth > _LEAST_DEPTH_PX
    radius = outline.disc_radius(mask)
    if leaves_picture or int((mask & (depth < 2 * _RIM_PX)).sum()) < _LEAST_RIM_PX:
        return UNKNOWN
    smooth = np.stack([masked_mean(shot, mask & usable, _SMOOTH_PX) for shot in light])
    s0, s1, s2 = np.linalg.pinv(mueller.analyzer(angle)) @ smooth[:, inside & usable]
    seen = inside & usable
    lit = s0 > 0
    seen[seen] = lit  # (H, W); its N pixels are those of the arrays below
    if not lit.any():
        return UNKNOWN
    polarization = (s1[lit] + 1j * s2[lit]) / s0[lit]  # (N,)
    strength = np.abs(polarization)
    weight = np.minimum(strength, outline.DOLP_CAP)
    slope = np.sqrt(polarization / np.maximum(strength, 1e-9)) * weight  # along the AoLP, of unknown sign
    outward = [_outward(mask, sigma) for sigma in (_RIM_PX, *(d * radius for d in _DEEPER))]
    outward.append(_outward(np.minimum(depth, _PLATEAU * radius), 2.0))
    rim, *deeper = (_turn(slope, gradient[seen]) for gradient in outward)  # rad
    scatter = float(np.sqrt(np.mean([(other - rim) ** 2 for other in deeper])))
    at_rim = outward[0][seen]
    length = np.abs(at_rim)
    hidden = float(np.abs(outward[0][inside & ~seen]).sum())  # share of the outline without light or with defects
    hidden /= max(hidden + float(length.sum()), 1e-9)
    # 0 for an outline with all directions alike: then the gains do not change its turn
    uneven = abs(complex((np.conj(at_rim) ** 2 / np.maximum(length, 1e-30)).sum()))
    uneven /= max(float(length @ weight), 1e-9)
    sector = outline.sectors(seen)
    by_part = [_turn(slope[sector == part], at_rim[sector == part]) for part in np.unique(sector)]
    variance = (
        _FLOOR**2 + (_SPREAD_TO_SIGMA * scatter) ** 2 + (hidden * np.std(by_part)) ** 2 + (gain_sigma * uneven / 2) ** 2
    )
    return RingZero(-rim, min(float(np.sqrt(variance)), np.pi / 2))


def _outward(inside: Floats | Bools, sigma: float) -> Complexes:
    """Outward gradient (H, W), as x + iy, y up, of a mask blurred by `sigma` px; a large blur uses a coarser grid."""
    step = max(1, int(sigma / _GRID_SIGMA))
    height, width = inside.shape
    small = area_mean(inside.astype(np.float32), (-(-height // step), -(-width // step)))
    direction, slope = outline.outward(small, sigma / step)
    x, y = (cv2.resize(part, (width, height)) for part in direction * slope)
    return np.asarray(x + 1j * y, np.complex128)


def _turn(slope: Complexes, outward: Complexes) -> float:
    """Mean angle [rad] from the outward direction to the slopes from polarization, with their signs outward."""
    product = slope * np.conj(outward)
    real, imaginary = np.ascontiguousarray(product.real), np.ascontiguousarray(product.imag)
    turn = 0.0
    for _ in range(_ITERATIONS):
        sign = np.copysign(1.0, real * np.cos(turn) + imaginary * np.sin(turn))
        turn = float(np.arctan2(imaginary @ sign, real @ sign))
    return turn


def by_slopes(light: Floats, usable: Bools, angle: Floats, gain_sigma: float) -> RingZero:
    """Error of the polarizer ring's zero, from slopes inside registered shots (K, H, W) without their gains.

    usable (H, W) are the object's pixels without defects, angle (K,) rad as stated, gain_sigma 1σ of gains, relative.
    """
    slopes = integrability.reduced_slopes(light, usable, angle)
    if slopes is None:
        return UNKNOWN
    start: Floats = np.append(np.ones(len(angle) - 1), 0.0)
    unknowns = start
    for _ in range(_ROUNDS):
        found = integrability.linearize(slopes, unknowns, _STEEPEST)
        weight = found.weight * (found.product.real > 0)
        step = _step(found, weight, unknowns - start, gain_sigma)
        unknowns = unknowns + np.clip(step, -_MOST_STEP, _MOST_STEP)
        if np.abs(step).max() < _SETTLED:
            break
    if integrability.linearize(slopes, unknowns, _STEEPEST).coherence <= integrability.COHERENT:
        return UNKNOWN
    part = integrability.part_of(slopes.inside)
    without = [_step(found, weight * (part != p), unknowns - start, gain_sigma)[-1] for p in np.unique(part)]
    sigma = float(np.hypot(jackknife(np.array(without)), _SLOPES_FLOOR))
    return RingZero(-float(unknowns[-1]), min(sigma, np.pi / 2))


def _step(found: integrability.Equations, weight: Floats, moved: Floats, gain_sigma: float) -> Floats:
    """Least-squares step (K,) of gains and angle error; a prior with 1σ of the gains limits their change `moved`."""
    noise = float((weight * found.residual**2).sum() / max(float(weight.sum()), 1e-9))
    prior = np.append(np.full(len(moved) - 1, 1 / max(gain_sigma, 1e-4) ** 2), 0.0) * noise * _CORRELATED
    return found.step(weight, prior, moved)
