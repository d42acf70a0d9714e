"""Stage 5: measure what differs from shot to shot: flash energy, and the polarizer's order, sense and offset.

One per cent of flash energy fakes as much polarization as a surface tilted by 24°. A matt grey patch
is unpolarized, so its brightness must be the same in every shot; where there is no chart, the object's
pixels that face the camera serve, which are the most alike. At the outline the surface
turns edge-on: there the polarization of diffuse light points across the contour, which tells whether
the angles are in order, counted the right way, and clocked.
"""

from itertools import permutations
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.errors import CaptureError
from polcap.images import Alignment, AngleStack, Bits, ColorCalibration, Floats, Gains, ObjectMask, Quality
from polcap.optics import mueller
from polcap.optics.warp import warp
from polcap.stages import stage

_GREY_PATCHES = (18, 19, 20, 21)  # white to neutral 5; the darker two are mostly noise
_ANCHOR_ERROR = 0.0025  # what facing pixels were wrong by on path-traced objects, whatever the noise
_KERNELS = (0.04, 0.02, 0.01, 0.007, 0.005)  # of the mean shift, in units of S1/S0
_MOST_ORDERS = 4  # with more shots the permutations are too many and too alike to judge


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    check_order: Annotated[
        bool, Meta(description="refuse a capture whose outline contradicts the order or sense of its angles")
    ] = True
    order_margin: Annotated[
        float,
        Meta(ge=0, le=2, description="how much better another order must fit the outline to be believed"),
    ] = 0.2


@stage(version=2)
def solve(
    radiance: AngleStack,
    alignment: Alignment,
    object_: ObjectMask,
    color: ColorCalibration,
    settings: Settings,
) -> Gains:
    """Gain of every shot and channel relative to the first, with the outline's verdict on the angles.

    Raises CaptureError where the outline clearly supports another order or sense of the angles.
    """
    value, quality = _registered(radiance, alignment, object_.crop)
    mask = object_.mask[object_.crop[1] : object_.crop[3], object_.crop[0] : object_.crop[2]]
    anchor, anchor_sigma = _facing_pixels(value, quality, mask)
    grey = _grey_patches(radiance, alignment, color)
    source: Literal["grey patches", "facing pixels"]
    if grey is not None:
        (gain, sigma), source = grey, "grey patches"
    else:
        gain, source = anchor, "facing pixels"
        sigma = np.hypot(anchor_sigma, _ANCHOR_ERROR) * (np.arange(len(gain)) > 0)[:, None]
    channel = gain.mean(1) / anchor.mean(1)
    verdict = _outline_verdict(value / gain[:, None, None], quality, mask, radiance.angle, object_.crop, radiance)
    scores, angle_offset, offset_sigma, concentration = verdict
    nominal = (tuple(range(len(gain))), False)
    best = max(scores, key=lambda hypothesis: scores[hypothesis])
    believable = 0.25 if source == "grey patches" else 0.45  # guessed gains turn AoLPs too
    if settings.check_order and scores[best] > believable and scores[best] - scores[nominal] > settings.order_margin:
        raise CaptureError(_disorder(best, scores, radiance.angle, nominal))
    return Gains(
        gain=gain,
        sigma=sigma,
        anchor=anchor,
        source=source,
        disagreement=float(np.maximum(np.abs(channel - 1) - 2 * anchor_sigma.mean(1), 0).max()),
        angle_offset=angle_offset,
        angle_offset_sigma=offset_sigma,
        concentration=concentration,
        order=best[0],
        mirrored=best[1],
    )


def _registered(radiance: AngleStack, alignment: Alignment, crop: tuple[int, int, int, int]) -> tuple[Floats, Bits]:
    """Shots on the reference grid, linear interpolation being enough for means: (K, h, w, 3), (h, w)."""
    value = np.stack([warp(v, t, crop, order=1) for v, t in zip(radiance.value, alignment.transform)])
    flagged = [warp(q.astype(np.float32), t, crop, order=1) > 0 for q, t in zip(radiance.quality, alignment.transform)]
    return value, np.where(np.any(flagged, axis=0), np.uint8(Quality.CLIPPED), np.uint8(0))


def _grey_patches(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> tuple[Floats, Floats] | None:
    """Gains (K, 3) and 1σ from the light grey patches, or None without a chart.

    Each patch is summed in every shot's own pixels; unclipped patches are pooled by their light.
    """
    if color.quads is None:
        return None
    shots = len(radiance.angle)
    total = np.zeros((shots, len(_GREY_PATCHES), 3))
    variance = np.zeros_like(total)
    usable = np.zeros(len(_GREY_PATCHES), bool)
    for p, patch in enumerate(_GREY_PATCHES):
        clipped = False
        for k in range(shots):
            inside = _polygon(color.quads[patch], alignment.transform[k], radiance.value.shape[1:3])
            count = inside.sum()
            clipped |= count < 9 or bool((radiance.quality[k][inside] & Quality.CLIPPED).any())
            total[k, p] = radiance.value[k][inside].mean(0) if count else 0
            variance[k, p] = radiance.variance[k][inside].sum(0) / max(count, 1) ** 2
        usable[p] = not clipped
    if not usable.any():
        return None
    light, noise = total[:, usable].sum(1), variance[:, usable].sum(1)
    gain = light / light[0]
    photon = gain * np.sqrt(noise / light**2 + (noise / light**2)[0])
    each = total[:, usable] / total[:1, usable]  # (K, P, 3)
    scatter = each.std(1) / np.sqrt(usable.sum())
    sigma = np.hypot(photon, scatter)
    sigma[0] = 0
    return _pooled(gain, sigma)


def _pooled(gain: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """One gain for all channels of a shot where they agree within 3σ: most flashes keep their colour."""
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    mean = (gain * weight).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    agree = (np.abs(gain - mean) <= 3 * np.maximum(sigma, 1e-6)).all(1, keepdims=True)
    pooled_sigma = np.sqrt(1 / weight.sum(1, keepdims=True)) * (sigma > 0)
    return np.where(agree, mean, gain), np.where(agree, pooled_sigma, sigma)


def _polygon(quad: Floats, transform: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(H, W) pixels of a shot inside a reference-grid quad (4, 2), one pixel within its edge."""
    corners = transform @ np.column_stack([quad, np.ones(4)]).T
    inside = np.zeros(shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, np.round((corners[:2] / corners[2]).T * 16).astype(np.int32), 1, shift=4)
    return np.asarray(cv2.erode(inside, np.ones((3, 3), np.uint8)) > 0)


def _facing_pixels(value: Floats, quality: Bits, mask: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Gains (K, 3) and 1σ from the object's own unclipped pixels.

    A surface that faces the camera is unpolarized, and most of a picture's pixels per unit of polarization
    are such: over a rounded object the density of (S1, S2)/S0 grows as 1/θ² towards its zero. So the ratios of
    the shots pile up where the gains are; mean shift with a shrinking kernel climbs there from their median.
    Albedo does not matter. The error is what the last kernels disagree by. A large flat tilted face misleads.

    References
    ----------
    Comaniciu & Meer, Mean shift, IEEE TPAMI 2002.
    """
    solid = cv2.erode(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    usable = (solid if solid.sum() > 100 else mask) & (quality == 0)
    if not usable.any():
        return np.ones((len(value), 3)), np.ones((len(value), 3))
    smooth = np.stack([cv2.GaussianBlur(v.astype(np.float32), (0, 0), 2.0) for v in value])
    total = smooth.sum(-1)  # (K, H, W)
    usable &= total.sum(0) > np.quantile(total.sum(0)[usable], 0.2)  # the darkest fifth is noise
    ratio = total[:, usable] / np.maximum(total[0, usable], 1e-12)  # (K, N)
    light = smooth[:, usable]
    at = np.median(ratio, axis=1)
    found = []
    for width in _KERNELS:
        for _ in range(50):
            weight = np.exp(-((ratio - at[:, None]) ** 2).sum(0) / (2 * width**2))
            before, at = at, ratio @ weight / max(float(weight.sum()), 1e-12)
            if np.abs(at - before).max() < 1e-6:
                break
        colored = np.einsum("knc,n->kc", light, weight / np.maximum(total[0, usable], 1e-12))
        found.append(colored / np.maximum(colored[0], 1e-12))
    return np.asarray(found[-1]), np.std(found[1:], axis=0)


def _outline_verdict(
    value: Floats,
    quality: Bits,
    mask: NDArray[np.bool_],
    angle: Floats,
    crop: tuple[int, int, int, int],
    radiance: AngleStack,
) -> tuple[dict[tuple[tuple[int, ...], bool], float], float, float, float]:
    """Score of every order and sense of the angles against the outline; offset, its 1σ and concentration.

    The score is Σ w cos 2(φ − φ_contour)/Σ w over the rim, 1 where the AoLP crosses the contour everywhere.
    """
    rim, contour = _rim(mask, crop, radiance.value.shape[1:3])
    rim &= quality == 0
    light = value[:, rim].sum(-1)  # (K, N)
    shots = len(angle)
    nominal = tuple(range(shots))
    orders = list(permutations(range(shots))) if shots <= _MOST_ORDERS else [nominal]
    scores: dict[tuple[tuple[int, ...], bool], float] = {}
    resultant = 0j
    count = 1.0
    for order in orders:
        for mirrored in (False, True):
            turned = angle[list(order)] * (-1 if mirrored else 1)
            s0, s1, s2 = (
                np.linalg.lstsq(mueller.analyzer(turned), light, rcond=None)[0] if rim.any() else np.zeros((3, 1))
            )
            polarization = (s1 + 1j * s2) / np.maximum(s0, 1e-9)  # DoLP e^{2iφ}
            weight = np.minimum(np.abs(polarization), 0.4)
            phasor = polarization / np.maximum(np.abs(polarization), 1e-12) * np.exp(-2j * contour[rim])
            mean = complex((weight * phasor).sum() / max(weight.sum(), 1e-9)) if rim.any() else 0j
            scores[order, mirrored] = mean.real
            if order == nominal and not mirrored:
                resultant = mean
                count = max(float(weight.sum() ** 2 / max((weight**2).sum(), 1e-12)), 1.0)
    concentration = abs(resultant)
    # Neighbouring rim pixels share their contour direction: about one in ten is independent.
    sigma = np.sqrt(max(1 - concentration**2, 0.0) / (2 * max(count / 10, 1))) / max(2 * concentration, 1e-3)
    return scores, float(np.angle(resultant) / 2), float(min(sigma, np.pi / 2)), float(concentration)


def _rim(
    mask: NDArray[np.bool_], crop: tuple[int, int, int, int], full: tuple[int, ...]
) -> tuple[NDArray[np.bool_], Floats]:
    """Band just inside the outline (H, W) and the azimuth of the outline's outward direction there, rad."""
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 3.0)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    band = (depth > 1.5) & (depth < max(5.0, 0.02 * max(mask.shape))) & (np.hypot(dx, dy) > 1e-4)
    x0, y0, x1, y1 = crop
    edge = 3  # where the object leaves the picture its outline is not a contour of shape
    band[: max(0, edge - y0)] = False
    band[:, : max(0, edge - x0)] = False
    band[mask.shape[0] - max(0, y1 - (full[0] - edge)) :] = False
    band[:, mask.shape[1] - max(0, x1 - (full[1] - edge)) :] = False
    return band, np.arctan2(dy, -dx)  # image rows run down


def _disorder(
    best: tuple[tuple[int, ...], bool],
    scores: dict[tuple[tuple[int, ...], bool], float],
    angle: Floats,
    nominal: tuple[tuple[int, ...], bool],
) -> str:
    names = ", ".join(f"{np.degrees(a):g}°" for a in angle)
    order, mirrored = best
    found = ", ".join(f"{np.degrees(angle[i]):g}°" for i in order)
    how = " counted the other way (the ring turned clockwise)" if mirrored else ""
    return (
        f"shots {names} contradict the object's outline (fit {scores[nominal]:.2f}): it supports "
        f"{found}{how} (fit {scores[best]:.2f}); correct the folders or --angles, shoot without ambient light "
        "(reflections turn polarization by 90°), or --set selfcal.check_order=false"
    )
