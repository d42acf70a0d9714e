"""Stage 5: measure what differs from shot to shot: flash energy, and the polarizer's order, sense and offset.

One per cent of flash energy fakes, where a surface faces the camera, the polarization of one tilted by 24° (over a
whole object it costs normals about 6° on average). A matt grey patch is unpolarized, so its brightness must be the
same in every shot (`grey_patches`); where there is no chart, the object itself says what it can (`object_gains`),
most of it by its slopes, which are those of a height (`integrability`), and what is known of lamps and flashes the
rest. One exposure of a polarization mosaic has one gain. The outline tells whether the angles are in order and
counted the right way (`order`), outline and inside by how much the ring's zero is off (`ring_zero`, `ring_by_slopes`);
that is applied where it is sure, joined with a calibrated zero by the errors of both. Of more than three shots their
closure tells which angle is wrong (`angle_closure`). Angles that nobody noted are found by `unknown_angles`.
"""

from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap import parallel
from polcap.errors import CaptureError
from polcap.images import Alignment, AngleStack, Bits, ColorCalibration, Floats, Gains, ObjectMask, Quality
from polcap.optics import frames
from polcap.optics.outline import Rim
from polcap.optics.warp import warp
from polcap.stages import stage
from polcap.stages.selfcal import (
    angle_closure,
    crossed_light,
    grey_patches,
    integrability,
    object_gains,
    order,
    ring_by_slopes,
    ring_zero,
    unknown_angles,
)
from polcap.stages.selfcal.grey_patches import GreyPatches
from polcap.stages.selfcal.object_gains import Estimate
from polcap.stages.selfcal.order import Order
from polcap.stages.selfcal.ring_zero import RingZero
from polcap.stages.selfcal.unknown_angles import Angles

_PRIOR = {"flash": 0.03, "steady": 0.01, "unknown": 0.03}  # 1σ of a shot's light before anything is measured: makers
# of studio flashes state 0.5–2 % from pop to pop at full recycling, of LED and HMI lamps under 1 %
_LEAST_PRIOR = 0.001  # of any light, whatever a calibration says of its flash
_SURPRISE = 3.0  # σ from the prior beyond which two independent measurements have to agree
_REMOUNTED = np.radians(0.3)  # 1σ of a filter's zero from one screwing on to the next: a thread's play; assumed
_SOLID_ORDER, _GUESSED_ORDER = 0.25, 0.45  # least score of another order; guessed gains turn AoLPs too. Set by hand;
# 32 simulated captures in order were all kept with them (tests/benchmarks/bench_verdicts.py)

_MOST_GAIN = 0.005  # 1σ of a shot's light; with less known, other angles explain the shots as well

Source = Literal["grey patches", "object", "one exposure", "none"]


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `selfcal` of a settings file."""

    unknown_angles: Annotated[
        bool,
        Meta(description="the stated angles are names only: find the true ones, of four shots and more beside a chart"),
    ] = False
    max_unknown_sigma_deg: Annotated[
        float, Meta(gt=0, le=20, description="angles that are found less well end the run [degrees]")
    ] = 4.0
    check_order: Annotated[
        bool, Meta(description="refuse a capture whose outline contradicts the order or sense of its angles")
    ] = True
    order_margin: Annotated[
        float,
        Meta(ge=0, le=2, description="how much better another order must fit the outline to be believed"),
    ] = 0.2
    correct_ring: Annotated[
        bool, Meta(description="turn all angles by what outline and slopes say of the ring's zero, where it is sure")
    ] = True
    ring_sigmas: Annotated[
        float, Meta(ge=1, le=20, description="so many times its own error must a turn of the ring be, to be sure [1σ]")
    ] = 3.0
    max_ring_sigma_deg: Annotated[
        float, Meta(gt=0, le=5, description="a turn of the ring known less well is not applied [degrees]")
    ] = 1.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(gt=0, le=20, description="a greater turn is not applied: it is no zero that was set by eye [degrees]"),
    ] = 12.0


@stage(version=13)
def solve(
    radiance: AngleStack,
    alignment: Alignment,
    object_: ObjectMask,
    color: ColorCalibration,
    settings: Settings,
) -> Gains:
    """Gain of every shot and channel relative to the first, with the outline's verdict on the angles.

    Parameters
    ----------
    radiance
        The shots (K, H, W, 3), each on its own grid.
    alignment
        Where each lies on the reference grid.
    object_
        Its mask and crop.
    color
        Tells where the chart's grey patches lie.
    settings
        Whether another order of the angles ends the run, and what it has to show.

    Raises
    ------
    CaptureError
        The outline clearly supports another order or sense of the angles.
    """
    shots = len(radiance.angle)
    x0, y0, x1, y1 = object_.crop
    mask = object_.mask[y0:y1, x0:x1]
    value, quality = _registered(radiance, alignment, object_.crop)
    light = object_gains.smoothed(value)
    facing = object_gains.facing(light, object_gains.inside(mask, quality), radiance.angle)
    greys = grey_patches.measure(radiance, alignment, color)
    blind = _blind(radiance, greys, facing)  # to the angles, which are to be judged
    rim = order.rim(light / blind.gain[:, None, None], quality == 0, mask, object_.crop, radiance.value.shape[1:3])
    unnoted: Angles | None = None
    if settings.unknown_angles:
        known = greys is not None or radiance.equipment.light == "one exposure"
        doubt = float(blind.sigma.max()) if known else np.inf
        unnoted = _unnoted(rim, light / blind.gain[:, None, None], mask, quality, doubt, settings)
        radiance = replace(radiance, angle=unnoted.angle)
        facing = object_gains.facing(light, object_gains.inside(mask, quality), radiance.angle)
    guessed = greys is None and radiance.equipment.light != "one exposure"
    found = order.judge(rim, radiance.angle, settings.order_margin, _GUESSED_ORDER if guessed else _SOLID_ORDER)
    stated: Order = (tuple(range(shots)), False)
    if settings.check_order and found.order != stated:
        raise CaptureError(_disorder(found, radiance.angle))
    doubt = float(blind.sigma.max())
    even = frames.total(value) / blind.gain[:, None, None]
    ring = ring_by_slopes.joined(
        ring_zero.measure(even, quality == 0, mask, radiance.angle, doubt, object_.border > 0),
        ring_by_slopes.measure(
            light / blind.gain[:, None, None], object_gains.inside(mask, quality), radiance.angle, doubt
        ),
    )
    correction = 0.0
    if radiance.equipment.light != "one exposure" or unnoted is not None:  # etched angles stay
        ring_sigma = radiance.equipment.ring_sigma if unnoted is None else unnoted.sigma
        ring, correction = corrected(ring, ring_sigma, settings)
    angle = radiance.angle + correction
    anchor = object_gains.combined([*_by_law(light, mask, quality, radiance, angle, object_.crop, facing), facing])
    source: Source
    gain: Floats
    sigma: Floats
    if radiance.equipment.light == "one exposure":
        gain, sigma, source = np.ones((shots, 3)), np.zeros((shots, 3)), "one exposure"
    elif greys is not None:
        gain, sigma, source = greys.gain, greys.sigma, "grey patches"
    else:
        believed = supported(anchor, _prior(radiance))
        gain, sigma = (np.repeat(part[:, None], 3, axis=1) for part in (believed.gain, believed.sigma))
        source = "object" if np.isfinite(anchor.sigma).all() else "none"
    closed = angle_closure.measure(
        *object_gains.cells(light / blind.gain[:, None, None], object_gains.inside(mask, quality)), angle, blind.sigma
    )
    crossed = crossed_light.measure(radiance, alignment, color, value, gain, angle, mask & (quality == 0), object_.crop)
    own = np.hypot(anchor.sigma, sigma.mean(1))
    difference = np.abs(gain.mean(1) / anchor.gain - 1)
    return Gains(
        gain=gain,
        sigma=sigma,
        anchor=np.repeat(anchor.gain[:, None], 3, axis=1),
        source=source,
        disagreement=float(np.max(np.where(np.isfinite(own), difference - _SURPRISE * own, 0), initial=0)),
        angle_offset=ring.turn,
        angle_offset_sigma=ring.sigma,
        angle_correction=correction,
        concentration=found.concentration,
        order=found.order[0],
        mirrored=found.order[1],
        anchor_sigma=np.where(np.isfinite(anchor.sigma), anchor.sigma, 1.0),
        grey_slope=float("nan") if greys is None else greys.slope,
        chart_gloss=0.0 if greys is None else greys.gloss,
        turned_shots=closed.shots,
        turned=closed.angle,
        turned_sigma=closed.sigma,
        rival=() if found.rival is None else found.rival[0],
        rival_mirrored=found.rival is not None and found.rival[1],
        found_angle=None if unnoted is None else unnoted.angle,
        found_sigma=0.0 if unnoted is None else unnoted.sigma,
        crossed=None if crossed is None else crossed[0],
        crossed_sigma=0.0 if crossed is None else crossed[1],
    )


def _unnoted(
    rim: Rim, even: Floats, mask: object_gains.Bools, quality: Bits, gain_sigma: float, settings: Settings
) -> Angles:
    """The angles that nobody noted, of shots (K, H, W) without their gains; else CaptureError says what is missing."""
    shots = len(even)
    otherwise = "or note the angles, and --set selfcal.unknown_angles=false"
    if shots < 4:
        raise CaptureError(f"{shots} shots at unknown angles: four are needed, better five; take more, {otherwise}")
    if gain_sigma > _MOST_GAIN:
        how = f"to {100 * gain_sigma:.1f} % only" if np.isfinite(gain_sigma) else "by no chart"
        raise CaptureError(
            f"the light of the shots is known {how}, for unknown angles {100 * _MOST_GAIN:g} % is the limit; "
            f"put a color chart beside the object, {otherwise}"
        )
    found = unknown_angles.measure(rim, *object_gains.cells(even, object_gains.inside(mask, quality)), shots)
    doubt = float(np.degrees(found.sigma))
    if doubt > settings.max_unknown_sigma_deg:
        raise CaptureError(
            f"outline and shots tell the polarizer's angles to {doubt:.1f}° only, "
            f"selfcal.max_unknown_sigma_deg = {settings.max_unknown_sigma_deg:g}; take five or more shots spread over "
            f"180° of a rounded object that is all in view, {otherwise}"
        )
    return found


def supported(anchor: Estimate, prior: float) -> Estimate:
    """What is believed of gains (K,): the object's, weighted against light that repeats within `prior` (1σ).

    A gain far from 1 that the object is not sure of is not applied: its distance from 1 is then the doubt.
    """
    later = np.arange(len(anchor.gain)) > 0
    known = np.isfinite(anchor.sigma)
    sigma = np.where(known, anchor.sigma, 1e6)
    distance = np.abs(anchor.gain - 1)
    surprising = distance > _SURPRISE * np.hypot(sigma, prior)
    weight, before = 1 / np.maximum(sigma, 1e-6) ** 2, 1 / prior**2
    mean = (weight * anchor.gain + before) / (weight + before)
    spread = 1 / np.sqrt(weight + before)
    certain = distance > 10 * sigma  # far off, and sharply measured: a pop that failed
    gain = np.where(surprising, np.where(certain, anchor.gain, 1.0), mean)
    doubt = np.where(surprising, np.where(certain, sigma, np.maximum(distance, prior)), spread)
    return Estimate(np.where(later, gain, 1.0), np.where(later, doubt, 0.0))


def _blind(radiance: AngleStack, greys: GreyPatches | None, facing: Estimate) -> Estimate:
    """Gains (K,) from what knows nothing of the angles."""
    if radiance.equipment.light == "one exposure":
        shots = len(radiance.angle)
        return Estimate(np.ones(shots), np.zeros(shots))
    if greys is not None:
        return Estimate(greys.gain.mean(1), greys.sigma.mean(1))
    return supported(facing, _prior(radiance))


def _prior(radiance: AngleStack) -> float:
    """1σ of a shot's light before anything is measured in this capture: of its kind of lamp, or as calibrated."""
    if radiance.equipment.light == "flash" and radiance.equipment.flash_spread is not None:
        return max(2**0.5 * radiance.equipment.flash_spread, _LEAST_PRIOR)  # of one pop against another
    return _PRIOR[radiance.equipment.light]


def corrected(ring: RingZero, calibrated: float | None, settings: Settings) -> tuple[RingZero, float]:
    """What is known of the ring's zero, and what is added to the angles for it, rad.

    A calibrated zero and the outline are two measurements of one number: they are joined by their errors, where both
    are of one ring. Where they are not, the filter was screwed on anew, and the outline stands alone.

    Parameters
    ----------
    ring
        By the outline.
    calibrated
        1σ rad of the zero that stands in the angles already, or to which angles were found; None where none does.
    settings
        When the outline is sure.
    """
    if calibrated is not None:
        before = float(np.hypot(calibrated, _REMOUNTED))
        if not settings.correct_ring or ring.sigma > np.radians(settings.max_ring_sigma_deg):
            return RingZero(0.0, min(before, ring.sigma)), 0.0
        if abs(ring.turn) <= _SURPRISE * np.hypot(before, ring.sigma):
            share = before**2 / (before**2 + ring.sigma**2)
            joined = RingZero(share * ring.turn, float(np.sqrt(share) * ring.sigma))
            return joined, joined.turn
    return ring, ring.turn if _sure(ring, settings) else 0.0


def _sure(ring: RingZero, settings: Settings) -> bool:
    """Whether the angles are better with the outline's turn than without."""
    return (
        settings.correct_ring
        and abs(ring.turn) > settings.ring_sigmas * ring.sigma
        and abs(ring.turn) <= np.radians(settings.max_ring_turn_deg)
        and ring.sigma <= np.radians(settings.max_ring_sigma_deg)
    )


def _by_law(
    light: Floats,
    mask: object_gains.Bools,
    quality: Bits,
    radiance: AngleStack,
    angle: Floats,
    crop: tuple[int, int, int, int],
    facing: Estimate,
) -> list[Estimate]:
    """What the object says of the gains if the angles (K,) rad are right."""
    at = order.rim(light, quality == 0, mask, crop, radiance.value.shape[1:3])
    inside = object_gains.inside(mask, quality)
    return parallel.results(
        [
            partial(object_gains.closure, light, inside, angle),
            partial(object_gains.outline, at.light, at.azimuth, at.sector, angle),
            partial(integrability.gains, light, inside, angle, facing.gain),
        ]
    )


def _registered(radiance: AngleStack, alignment: Alignment, crop: tuple[int, int, int, int]) -> tuple[Floats, Bits]:
    """Shots on the reference grid, linear interpolation being enough for means: (K, h, w, 3), (h, w)."""
    value = np.stack([warp(v, t, crop, order=1) for v, t in zip(radiance.value, alignment.transform)])
    flagged = [warp(q.astype(np.float32), t, crop, order=1) > 0 for q, t in zip(radiance.quality, alignment.transform)]
    return value, np.where(np.any(flagged, axis=0), np.uint8(Quality.CLIPPED), np.uint8(0))


def _disorder(found: order.Verdict, angle: Floats) -> str:
    names = ", ".join(f"{np.degrees(a):g}°" for a in angle)
    which, mirrored = found.order
    best = ", ".join(f"{np.degrees(angle[i]):g}°" for i in which)
    how = " counted the other way (the ring turned clockwise)" if mirrored else ""
    return (
        f"shots {names} contradict the object's outline (fit {found.score:.2f}): it supports "
        f"{best}{how} (fit {found.best_score:.2f}); correct the folders or --angles, shoot without ambient light "
        "(reflections turn polarization by 90°), or --set selfcal.check_order=false"
    )
