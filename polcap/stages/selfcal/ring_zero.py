"""By how much the zero of the polarizer ring is off, told by the object's outline.

Body light is polarized along the slope g = tan θ (cos φ, sin φ) of the surface. A slope has no curl: along a closed
curve inside the outline, ∮ g·t = 0 on any smooth surface, symmetrical or not. A ring whose zero is off by δ turns g,
and then ∮ g·t / ∮ g·n = tan δ, n pointing out of the curve. Instead of one curve a band of them is taken: the contours
of a blurred mask. The DoLP stands for tan θ; any weight does on a symmetrical object.

What the law does not hold for (hidden parts, sharp edges, reflected light, light thrown from fold to fold) acts
differently at different depths, so the spread over depths tells the error (decision 26).
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Floats
from polcap.optics import mueller, outline

Bools = NDArray[np.bool_]

_RIM_PX = 3.0  # 1σ of the blur whose contours are followed: as near to the outline as pixels allow
_FINE_PX = 8.0  # 1σ of a blur in px of the grid that it is made on: an eighth of it is all that the grid adds
_DEEPER = (0.1, 0.2)  # further blurs, in radii of the object
_PLATEAU = 0.3  # radii; the contours of the depth up to here are the last band
_SMOOTH_PX = 1.0  # of the light, inside the object only
_LEAST_DEPTH_PX = 1.5  # nearer, a pixel is partly backdrop
_SPREAD_TO_SIGMA = 2.0  # error of the rim's answer over its rms distance from the deeper ones (decision 26)
_FLOOR = np.radians(0.25)  # where all depths agree (decision 26)
_LEAST_RIM_PX = 200
_TURNS = 4  # of the answer into the angles, until it no longer changes


@dataclass(frozen=True)
class RingZero:
    """The ring's error; stated angle + turn = true angle."""

    turn: float  # rad
    sigma: float  # rad, 1σ; π/2 where nothing is known


UNKNOWN = RingZero(0.0, np.pi / 2)


def measure(
    light: Floats, usable: Bools, mask: Bools, angle: Floats, gain_sigma: float, leaves_picture: bool
) -> RingZero:
    """The ring's error, of registered shots without their gains.

    Parameters
    ----------
    light
        (K, H, W) shots.
    usable
        (H, W) pixels to be believed.
    mask
        (H, W) the object.
    angle
        (K,) rad, as stated.
    gain_sigma
        1σ of the shots' gains, relative.
    leaves_picture
        Where the object touches the picture's edge there is no closed curve, and no answer.
    """
    margin = int(np.ceil(4 * _RIM_PX))
    light = np.pad(light, ((0, 0), (margin, margin), (margin, margin)))
    usable, mask = np.pad(usable, margin), np.pad(mask, margin)
    depth = outline.depth(mask)
    inside = depth > _LEAST_DEPTH_PX
    radius = float(np.sqrt(mask.sum() / np.pi))
    if leaves_picture or int((mask & (depth < 2 * _RIM_PX)).sum()) < _LEAST_RIM_PX:
        return UNKNOWN
    ok = (mask & usable).astype(np.float32)
    share = cv2.GaussianBlur(ok, (0, 0), _SMOOTH_PX) + 1e-6
    light = np.stack([cv2.GaussianBlur((shot * ok).astype(np.float32), (0, 0), _SMOOTH_PX) / share for shot in light])
    seen = inside & usable
    s0, s1, s2 = np.linalg.pinv(mueller.analyzer(angle)) @ light[:, seen]
    lit = s0 > 0
    seen[seen] = lit
    if not lit.any():
        return UNKNOWN
    polarization = (s1[lit] + 1j * s2[lit]) / s0[lit]  # (N,), as all that follows
    strength = np.abs(polarization)
    weight = np.minimum(strength, outline.DOLP_CAP)
    slope = np.sqrt(polarization / np.maximum(strength, 1e-9)) * weight  # along it or against it: half the angle
    out = parallel.results(partial(_outward_of, mask, sigma) for sigma in (_RIM_PX, *(d * radius for d in _DEEPER)))
    out.append(_outward(cv2.GaussianBlur(np.minimum(depth, _PLATEAU * radius), (0, 0), 2.0)))
    rim, *deeper = parallel.results(partial(_turned, slope, way[seen]) for way in out)
    spread = float(np.sqrt(np.mean([(other - rim) ** 2 for other in deeper])))
    lying = out[0][seen]
    length = np.abs(lying)
    hidden = float(np.abs(out[0][inside & ~seen]).sum())
    hidden /= max(hidden + float(length.sum()), 1e-9)
    lopsided = abs(complex((np.conj(lying) ** 2 / np.maximum(length, 1e-30)).sum()))
    lopsided /= max(float(length @ weight), 1e-9)
    sigma = float(
        np.sqrt(
            _FLOOR**2
            + (_SPREAD_TO_SIGMA * spread) ** 2
            + (hidden * _scatter(slope, lying, outline.sectors(seen))) ** 2
            + (gain_sigma * lopsided / 2) ** 2
        )
    )
    return RingZero(-rim, min(sigma, np.pi / 2))


def _outward(inside: Floats) -> NDArray[np.complex128]:
    """The way out of a picture that is larger further in, (H, W) as x + iy, y up, as long as its slope."""
    return np.asarray(-cv2.Sobel(inside, cv2.CV_64F, 1, 0) + 1j * cv2.Sobel(inside, cv2.CV_64F, 0, 1))


def _outward_of(mask: Bools, sigma: float) -> NDArray[np.complex128]:
    """`_outward` of a mask blurred by `sigma` px; where that is much, on a grid as much coarser."""
    step = max(1, int(sigma / _FINE_PX))
    height, width = mask.shape
    small = cv2.resize(mask.astype(np.float32), (-(-width // step), -(-height // step)), interpolation=cv2.INTER_AREA)
    way = _outward(cv2.GaussianBlur(small, (0, 0), sigma / step))
    if step == 1:
        return way
    return np.asarray(cv2.resize(way.view(np.float64).reshape(*way.shape, 2), (width, height)) @ np.array([1, 1j]))


def _turned(slope: NDArray[np.complex128], out: NDArray[np.complex128]) -> float:
    """Angle of Σ g conj(out), rad: of the two opposite slopes that an AoLP means the one nearer to the way out."""
    lying = slope * np.conj(out)
    along, across = np.ascontiguousarray(lying.real), np.ascontiguousarray(lying.imag)
    turn = 0.0
    for _ in range(_TURNS):
        way = np.copysign(1.0, along * np.cos(turn) + across * np.sin(turn))
        turn = float(np.arctan2(across @ way, along @ way))
    return turn


def _scatter(slope: NDArray[np.complex128], out: NDArray[np.complex128], sector: NDArray[np.int_]) -> float:
    """How far parts of the outline differ from one another, 1σ rad."""
    parts = parallel.results(partial(_turned, slope[sector == s], out[sector == s]) for s in np.unique(sector))
    return float(np.std(parts))
