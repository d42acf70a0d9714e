"""Stage 5: differences between the shots: flash energy, and the polarizer's order, sense and zero.

One per cent of flash energy fakes, where a surface faces the camera, the polarization of one tilted by 24° (over a
whole object it costs normals about 6° on average). A matt grey patch is unpolarized, so its brightness must be the
same in every shot (`grey_patches`). Without a chart the gains come from the object (`object_gains`), most of them from
its slopes (`integrability`), averaged with the known repeatability of lamps and flashes. One exposure of a
polarization mosaic has one gain. `angles` checks the order and sense of the angles on the outline, finds one turned
shot among more than three, and finds angles that nobody noted. `ring_zero` measures the zero of the polarizer's ring;
its error is corrected where it is certain, averaged with a calibrated zero by the errors of both.
"""

from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap import parallel
from polcap.errors import CaptureError
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Gains, ObjectMask, RingZero, SelfCalibration
from polcap.optics import frames
from polcap.optics.outline import OutlineBand
from polcap.stages import stage
from polcap.stages.selfcal import angles, crossed_light, grey_patches, integrability, object_gains, ring_zero
from polcap.stages.selfcal.grey_patches import GreyPatches
from polcap.stages.selfcal.object_gains import GainEstimate, ObjectShots

_PRIOR = {"flash": 0.03, "steady": 0.01, "unknown": 0.03}  # 1σ of a shot's light before anything is measured: makers
# of studio flashes state 0.5–2 % from pop to pop at full recycling, of LED and HMI lamps under 1 %
_LEAST_PRIOR = 0.001  # of any light, whatever a calibration states of its flash
_SURPRISE = 3.0  # σ beyond which two measurements contradict one another
_REMOUNTED = np.radians(0.3)  # 1σ of a filter's zero from one screwing on to the next: a thread's play; assumed
_SOLID_ORDER, _GUESSED_ORDER = 0.25, 0.45  # least score of another order; guessed gains turn AoLPs too. Set by hand;
# none of 32 simulated captures in order was refused with them (tests/benchmarks/bench_verdicts.py)
_MOST_GAIN = 0.005  # 1σ of a shot's light; with more, other angles explain the shots as well


class SelfcalSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `selfcal` of a settings file."""

    unknown_angles: Annotated[
        bool,
        Meta(description="the stated angles are names only: find the true ones, of four or more shots with a chart"),
    ] = False
    max_unknown_sigma_deg: Annotated[
        float, Meta(gt=0, le=20, description="greatest 1σ of angles that are found; more ends the run [degrees]")
    ] = 4.0
    check_order: Annotated[
        bool, Meta(description="refuse a capture whose outline contradicts the order or sense of its angles")
    ] = True
    order_margin: Annotated[
        float,
        Meta(ge=0, le=2, description="least lead of another order's fit of the outline over the stated one's"),
    ] = 0.2
    correct_ring: Annotated[
        bool, Meta(description="correct all angles by the measured error of the ring's zero, where it is certain")
    ] = True
    ring_sigmas: Annotated[
        float,
        Meta(ge=1, le=20, description="least error of the ring's zero that is corrected, over its own error [1σ]"),
    ] = 3.0
    max_ring_sigma_deg: Annotated[
        float, Meta(gt=0, le=5, description="greatest 1σ of a correction of the ring's zero [degrees]")
    ] = 1.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(gt=0, le=20, description="greatest correction of the ring's zero; more is no zero set by eye [degrees]"),
    ] = 12.0


@stage(version=14)
def solve(
    radiance: AngleStack,
    alignment: Alignment,
    object_: ObjectMask,
    color: ColorCalibration,
    settings: SelfcalSettings,
) -> SelfCalibration:
    """Gain of every shot and channel, and the polarizer's angles, checked and corrected.

    The shots (K, H, W, 3) are compared on the object's crop and on the chart's grey patches, if any.

    Raises
    ------
    CaptureError
        The outline contradicts the order or sense of the angles, or unknown angles cannot be found.
    """
    shots = object_gains.register(radiance, alignment, object_)
    greys = grey_patches.measure(radiance, alignment, color)
    facing = object_gains.facing(shots.light, shots.inside, radiance.angle)
    first = _gains_without_angles(radiance, greys, facing)
    even = replace(shots, light=shots.light / first.gain[:, None, None])
    rim = angles.rim(even)

    angle, found_sigma = radiance.angle, None
    if settings.unknown_angles:
        well_known = greys is not None or radiance.equipment.light == "one exposure"
        angle, found_sigma = _find_angles(rim, even, float(first.sigma.max()) if well_known else np.inf, settings)
        facing = object_gains.facing(shots.light, shots.inside, angle)
    guessed = greys is None and radiance.equipment.light != "one exposure"
    order = angles.check_order(rim, angle, settings.order_margin, _GUESSED_ORDER if guessed else _SOLID_ORDER)
    if settings.check_order and not order.check.as_stated:
        raise CaptureError(_wrong_order(order, angle))

    ring = _ring(even, angle, first, object_.border > 0)
    if radiance.equipment.light != "one exposure" or found_sigma is not None:  # etched angles are exact
        ring = corrected(ring, radiance.equipment.ring_sigma if found_sigma is None else found_sigma, settings)
    angle = angle + ring.correction

    with_gains = replace(rim, light=rim.light * first.gain[:, None])
    by_angles = parallel.results(
        [
            partial(object_gains.closure, shots.light, shots.inside, angle),
            partial(object_gains.outline, with_gains, angle),
            partial(integrability.gains, shots.light, shots.inside, angle, facing.gain),
        ]
    )
    gains = _gains(radiance, greys, object_gains.combined([*by_angles, facing]))
    return SelfCalibration(
        gains=gains,
        angle=angle,
        outline=order.check,
        ring=ring,
        turned=angles.turned_shot(*object_gains.cells(even.light, even.inside), angle, first.sigma),
        found_sigma=found_sigma,
        crossed=crossed_light.measure(radiance, alignment, color, shots, gains.gain, angle),
    )


def _gains_without_angles(radiance: AngleStack, greys: GreyPatches | None, facing: GainEstimate) -> GainEstimate:
    """Gains (K,) that do not depend on the angles, which are still to be checked."""
    if radiance.equipment.light == "one exposure":
        shots = len(radiance.angle)
        return GainEstimate(np.ones(shots), np.zeros(shots))
    if greys is not None:
        return GainEstimate(greys.gain.mean(1), greys.sigma.mean(1))
    return object_gains.with_prior(facing, _prior(radiance))


def _gains(radiance: AngleStack, greys: GreyPatches | None, anchor: GainEstimate) -> Gains:
    """Gains (K, 3) by the best source at hand, with the object's own (`anchor`) as the cross-check."""
    gain: Floats
    sigma: Floats
    source: Literal["grey patches", "object", "one exposure", "none"]
    if radiance.equipment.light == "one exposure":
        gain, sigma, source = np.ones((len(anchor.gain), 3)), np.zeros((len(anchor.gain), 3)), "one exposure"
    elif greys is not None:
        gain, sigma, source = greys.gain, greys.sigma, "grey patches"
    else:
        believed = object_gains.with_prior(anchor, _prior(radiance))
        gain, sigma = (np.repeat(part[:, None], 3, axis=1) for part in (believed.gain, believed.sigma))
        source = "object" if np.isfinite(anchor.sigma).all() else "none"
    both = np.hypot(anchor.sigma, sigma.mean(1))
    difference = np.abs(gain.mean(1) / anchor.gain - 1)
    return Gains(
        gain=gain,
        sigma=sigma,
        anchor=np.repeat(anchor.gain[:, None], 3, axis=1),
        source=source,
        disagreement=float(np.max(np.where(np.isfinite(both), difference - _SURPRISE * both, 0), initial=0)),
        grey_slope=float("nan") if greys is None else greys.slope,
        chart_gloss=0.0 if greys is None else greys.gloss,
    )


def _prior(radiance: AngleStack) -> float:
    """1σ of a shot's light before anything is measured in this capture: of its kind of lamp, or as calibrated."""
    if radiance.equipment.light == "flash" and radiance.equipment.flash_spread is not None:
        return max(2**0.5 * radiance.equipment.flash_spread, _LEAST_PRIOR)  # of one pop against another
    return _PRIOR[radiance.equipment.light]


def _find_angles(
    band: OutlineBand, even: ObjectShots, gain_sigma: float, settings: SelfcalSettings
) -> tuple[Floats, float]:
    """Angles (K,) rad that nobody noted, and their 1σ, of shots without their gains."""
    shots = len(even.light)
    otherwise = "or note the angles, and --set selfcal.unknown_angles=false"
    if shots < 4:
        raise CaptureError(f"{shots} shots at unknown angles: four are needed, better five; take more, {otherwise}")
    if gain_sigma > _MOST_GAIN:
        known = f"known to {100 * gain_sigma:.1f} % only" if np.isfinite(gain_sigma) else "not known without a chart"
        raise CaptureError(
            f"the light of the shots is {known}; to find unknown angles it must be known to {100 * _MOST_GAIN:g} %: "
            f"put a color chart next to the object, {otherwise}"
        )
    found = angles.find(band, *object_gains.cells(even.light, even.inside))
    sigma = float(np.degrees(found.sigma))
    if sigma > settings.max_unknown_sigma_deg:
        raise CaptureError(
            f"the polarizer's angles are found to {sigma:.1f}° only, "
            f"selfcal.max_unknown_sigma_deg = {settings.max_unknown_sigma_deg:g}; take five or more shots spread over "
            f"180° of a rounded object that is all in view, {otherwise}"
        )
    return found.angle, found.sigma


def _wrong_order(found: angles.OrderFit, angle: Floats) -> str:
    """The message for shots whose outline contradicts their angles (K,) rad."""
    stated = ", ".join(f"{np.degrees(a):g}°" for a in angle)
    best = ", ".join(f"{np.degrees(angle[i]):g}°" for i in found.check.best.shots)
    mirrored = " counted the other way (the ring turned clockwise)" if found.check.best.mirrored else ""
    return (
        f"shots {stated} contradict the object's outline (fit {found.score:.2f}): it supports "
        f"{best}{mirrored} (fit {found.best_score:.2f}); correct the folders or --angles, shoot without ambient light "
        "(reflections turn polarization by 90°), or --set selfcal.check_order=false"
    )


def _ring(even: ObjectShots, angle: Floats, gains: GainEstimate, leaves_picture: bool) -> RingZero:
    """The error of the ring's zero by outline and slopes together; not corrected yet."""
    gain_sigma = float(gains.sigma.max())
    total = frames.total(even.value) / gains.gain[:, None, None]
    return ring_zero.combined(
        ring_zero.by_outline(total, even.quality == 0, even.mask, angle, gain_sigma, leaves_picture),
        ring_zero.by_slopes(even.light, even.inside, angle, gain_sigma),
    )


def corrected(ring: RingZero, calibrated: float | None, settings: SelfcalSettings) -> RingZero:
    """The ring's zero with the correction that is added to the angles.

    `calibrated` is 1σ (rad) of a zero that the angles already include, by calibration or because they were found; None
    without one. It and the ring's measured error are averaged by their errors where they agree. Where they do not, the
    filter was mounted again, and the measurement counts alone.
    """
    uncertain = ring.sigma > np.radians(settings.max_ring_sigma_deg)
    if calibrated is not None:
        before = float(np.hypot(calibrated, _REMOUNTED))
        if not settings.correct_ring or uncertain:
            return RingZero(0.0, min(before, ring.sigma))
        if abs(ring.offset) <= _SURPRISE * np.hypot(before, ring.sigma):
            share = before**2 / (before**2 + ring.sigma**2)
            return RingZero(share * ring.offset, float(np.sqrt(share) * ring.sigma), share * ring.offset)
    certain = (
        settings.correct_ring
        and abs(ring.offset) > settings.ring_sigmas * ring.sigma
        and abs(ring.offset) <= np.radians(settings.max_ring_turn_deg)
        and not uncertain
    )
    return replace(ring, correction=ring.offset if certain else 0.0)
