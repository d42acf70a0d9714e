"""Stage 5: self-calibration of the shots: gains, and the polarizer's order, sense and zero.

An error of 1 % in flash energy gives a surface that faces the camera the polarization of a surface tilted by 24°; over
a whole object it costs about 6° of the normals on average. A matt grey patch is unpolarized, so its brightness must be
the same in every shot (`grey_patches`). Without a chart, the gains come from the object (`object_gains`,
`integrability`), averaged with the known repeatability of lamps and flashes. One exposure of a polarization mosaic has
one gain. `angles` checks the order and sense of the angles at the outline, and detects one turned shot among more than
three. `unknown_angles` finds angles that nobody noted. `ring_zero` measures the zero of the polarizer's ring. Its error
is corrected if it is significant; a calibrated zero is averaged with it by the errors of both.
"""

from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap import parallel
from polcap.capture_values import AngleStatement
from polcap.chart_values import ColorCalibration
from polcap.errors import CaptureError
from polcap.formats.capture import angle_advice
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.optics.outline import OutlineBand
from polcap.stage_values import Alignment, AngleStack, Gains, ObjectMask, RingZero, SelfCalibration
from polcap.stages import stage
from polcap.stages.selfcal import (
    angles,
    crossed_light,
    grey_patches,
    integrability,
    object_gains,
    ring_zero,
    unknown_angles,
)
from polcap.stages.selfcal.grey_patches import GreyPatches
from polcap.stages.selfcal.object_gains import GainEstimate, ObjectShots

# Prior 1σ of a shot's light, relative. Makers state 0.5–2 % from flash to flash for studio flashes at full recycling,
# and under 1 % for LED and HMI lamps.
_PRIOR = {"flash": 0.03, "steady": 0.01, "unknown": 0.03}
_LEAST_PRIOR = 0.001  # least prior 1σ, also of a calibrated flash
_CONTRADICTION = 3.0  # σ; two measurements that differ by more contradict each other
_FLAT_ERROR = 0.05  # error of the gains by facing pixels of an object with flat faces (8 path-traced captures)
_REMOUNTED = np.radians(0.3)  # 1σ of the zero after a filter is screwed on again (play of the thread); assumed
# Least score of another order with measured gains, and with gains from the object, whose errors turn AoLPs. Set by
# hand; none of 32 simulated captures in the right order was refused (tests/benchmarks/bench_verdicts.py).
_LEAST_SCORE, _LEAST_SCORE_BY_OBJECT = 0.25, 0.45
_MOST_GAIN = 0.005  # largest 1σ of a shot's light with which unknown angles can be found


class SelfcalSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `selfcal`, the section `selfcal` of a settings file."""

    unknown_angles: Annotated[
        bool, Meta(description="ignore the stated angles and find them, from four or more shots with a chart")
    ] = False
    max_unknown_sigma_deg: Annotated[
        float, Meta(gt=0, le=20, description="greatest 1σ of found angles; more ends the run [degrees]")
    ] = 4.0
    check_order: Annotated[
        bool, Meta(description="refuse a capture whose outline contradicts the order or sense of its angles")
    ] = True
    order_margin: Annotated[
        float,
        Meta(
            ge=0,
            le=2,
            description="an order of the angles is refused if another one fits the outline better by this score",
        ),
    ] = 0.2
    correct_ring: Annotated[
        bool, Meta(description="correct all angles by the measured error of the ring's zero, if it is significant")
    ] = True
    ring_sigmas: Annotated[
        float,
        Meta(
            ge=1,
            le=20,
            description="the ring's zero is corrected if it is off by this many times its uncertainty or more [1σ]",
        ),
    ] = 3.0
    max_ring_sigma_deg: Annotated[
        float, Meta(gt=0, le=5, description="greatest 1σ of a correction of the ring's zero [degrees]")
    ] = 1.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(
            gt=0, le=20, description="greatest correction of the ring's zero; a larger error is not corrected [degrees]"
        ),
    ] = 12.0


@stage(version=20)
def solve(
    radiance: AngleStack, alignment: Alignment, object_: ObjectMask, color: ColorCalibration, settings: SelfcalSettings
) -> SelfCalibration:
    """Self-calibrate: gains (K, 3) of all shots and channels, and checked and corrected polarizer angles (K,).

    The shots (K, H, W, 3) are compared in the object's crop and on the chart's grey patches, if any.

    Raises CaptureError: the outline contradicts the order or sense of the angles, or unknown angles cannot be found.
    """
    shots = object_gains.register(radiance, alignment, object_)
    greys = grey_patches.measure(radiance, alignment, color)
    facing = object_gains.facing(shots.light, shots.inside, radiance.angle)
    gain, sigma, _ = _best_gains(radiance, greys, facing)  # without the angles, because these are not checked yet
    first = GainEstimate(gain.mean(1), sigma.mean(1))
    equalized = replace(shots, light=shots.light / first.gain[:, None, None])  # as under equal light
    rim = angles.rim(equalized)
    one_exposure = radiance.equipment.light == "one exposure"
    well_known = greys is not None or one_exposure

    angle, found_sigma = radiance.angle, None
    if settings.unknown_angles:
        angle, found_sigma = _find_angles(rim, equalized, float(first.sigma.max()) if well_known else np.inf, settings)
        facing = object_gains.facing(shots.light, shots.inside, angle)
    least_score = _LEAST_SCORE if well_known else _LEAST_SCORE_BY_OBJECT
    order = angles.check_order(rim, angle, settings.order_margin, least_score)
    if settings.check_order and not order.check.as_stated:
        raise CaptureError(_wrong_order(order, angle, radiance.equipment.angles))

    ring = _ring(equalized, angle, first, object_.border > 0)
    if found_sigma is not None or not one_exposure:  # the angles of a polarization mosaic are exact
        ring = corrected(ring, radiance.equipment.ring_sigma if found_sigma is None else found_sigma, settings)
    angle = angle + ring.correction

    with_gains = replace(rim, light=rim.light * first.gain[:, None])
    by_closure = partial(object_gains.closure, shots.light, shots.inside, angle)
    by_outline = partial(object_gains.outline, with_gains, angle)
    by_slopes = partial(integrability.gains, shots.light, shots.inside, angle, facing.gain)
    by_angles = parallel.results([by_closure, by_outline, by_slopes])
    if not np.isfinite(by_angles[-1].sigma).all():  # flat faces: most pixels may share a polarization
        facing = replace(facing, sigma=np.hypot(facing.sigma, np.where(facing.sigma > 0, _FLAT_ERROR, 0)))
    gains = _gains(radiance, greys, object_gains.combined([*by_angles, facing]))
    return SelfCalibration(
        gains=gains,
        angle=angle,
        outline=order.check,
        ring=ring,
        turned=angles.turned_shot(*object_gains.cells(equalized.light, equalized.inside), angle, first.sigma),
        found_sigma=found_sigma,
        crossed=crossed_light.measure(radiance, alignment, color, shots, gains.gain, angle),
        other_orders=angles.other_orders(order.check, angle),
    )


def _best_gains(
    radiance: AngleStack, greys: GreyPatches | None, by_object: GainEstimate
) -> tuple[Floats, Floats, Literal["grey patches", "object", "one exposure", "none"]]:
    """Gains (K, 3) of the shots from the best source, their 1σ, and the source: one exposure, patches or object."""
    shape = len(radiance.angle), 3
    if radiance.equipment.light == "one exposure":
        return np.ones(shape), np.zeros(shape), "one exposure"
    if greys is not None:
        return greys.gain, greys.sigma, "grey patches"
    known = object_gains.with_prior(by_object, _prior(radiance))
    source: Literal["object", "none"] = "object" if np.isfinite(by_object.sigma).all() else "none"
    return known.gain[:, None].repeat(3, axis=1), known.sigma[:, None].repeat(3, axis=1), source


def _gains(radiance: AngleStack, greys: GreyPatches | None, anchor: GainEstimate) -> Gains:
    """Gains (K, 3) of the shots from the best source, cross-checked with those from the object (`anchor`)."""
    gain, sigma, source = _best_gains(radiance, greys, anchor)
    both = np.hypot(anchor.sigma, sigma.mean(1))
    difference = np.abs(gain.mean(1) / anchor.gain - 1)
    return Gains(
        gain=gain,
        sigma=sigma,
        anchor=np.repeat(anchor.gain[:, None], 3, axis=1),
        source=source,
        disagreement=float(np.max(np.where(np.isfinite(both), difference - _CONTRADICTION * both, 0), initial=0)),
        grey_slope=float("nan") if greys is None else greys.slope,
        chart_gloss=0.0 if greys is None else greys.gloss,
    )


def _prior(radiance: AngleStack) -> float:
    """Prior 1σ of a shot's light, relative, by the kind of lamp or from a calibration."""
    if radiance.equipment.light == "flash" and radiance.equipment.flash_spread is not None:
        return max(2**0.5 * radiance.equipment.flash_spread, _LEAST_PRIOR)  # difference of two flashes
    return _PRIOR[radiance.equipment.light]


def _find_angles(
    band: OutlineBand, equalized: ObjectShots, gain_sigma: float, settings: SelfcalSettings
) -> tuple[Floats, float]:
    """Find unknown polarizer angles (K,) and their 1σ, rad, from shots divided by their gains."""
    shots = len(equalized.light)
    remedy = "or use the stated angles: --set selfcal.unknown_angles=false"
    if shots < 4:
        raise CaptureError(
            f"{shots} shots at unknown angles: at least four are needed, five are better; take more, {remedy}"
        )
    if gain_sigma > _MOST_GAIN:
        known = f"known to only {100 * gain_sigma:.1f} %" if np.isfinite(gain_sigma) else "not known without a chart"
        raise CaptureError(
            f"the flash energy of the shots is {known}; to find unknown angles, {100 * _MOST_GAIN:g} % is needed: "
            f"put a color chart next to the object, {remedy}"
        )
    found, sigma = unknown_angles.find_angles(band, *object_gains.cells(equalized.light, equalized.inside))
    sigma_deg = float(np.degrees(sigma))
    if sigma_deg > settings.max_unknown_sigma_deg:
        raise CaptureError(
            f"the error of the polarizer angles found is {sigma_deg:.1f}° (1σ), more than "
            f"selfcal.max_unknown_sigma_deg = {settings.max_unknown_sigma_deg:g}; take five or more shots spread over "
            f"180°, of a rounded object inside the picture, {remedy}"
        )
    return found, sigma


def _wrong_order(found: angles.OrderFit, angle: Floats, statement: AngleStatement) -> str:
    """Error message for shots with angles (K,) rad that contradict the polarization at the object's outline."""
    names = [f"{np.degrees(a):g}°" for a in angle]
    stated, best = ", ".join(names), ", ".join(names[i] for i in found.check.best.shots)
    mirrored = " counted clockwise" if found.check.best.mirrored else ""
    remedy = angle_advice.correct(statement, found.check.best, angle)
    return (
        f"the angles {stated} contradict the polarization at the object's outline (fit {found.check.score:.2f}); "
        f"{best}{mirrored} fit better ({found.best_score:.2f}): {remedy}; "
        "or shoot in a dark room (reflections turn polarization by 90°), or --set selfcal.check_order=false"
    )


def _ring(equalized: ObjectShots, angle: Floats, gains: GainEstimate, leaves_picture: bool) -> RingZero:
    """Measure the zero error of the polarizer's ring by the object's outline and slopes; nothing is corrected."""
    gain_sigma = float(gains.sigma.max())
    total = frames.total(equalized.value) / gains.gain[:, None, None]
    return ring_zero.combined(
        ring_zero.by_outline(total, equalized.quality == 0, equalized.mask, angle, gain_sigma, leaves_picture),
        ring_zero.by_slopes(equalized.light, equalized.inside, angle, gain_sigma),
    )


def corrected(ring: RingZero, calibrated: float | None, settings: SelfcalSettings) -> RingZero:
    """Decide on the correction of the polarizer angles for the measured error of the ring's zero.

    `calibrated` is 1σ [rad] of a zero that the angles already include, by calibration or because the angles were found;
    None without one. If it agrees with the measured error, the two are averaged by their errors. If not, the filter was
    probably mounted again, and only the measurement is used.
    """
    uncertain = ring.sigma > np.radians(settings.max_ring_sigma_deg)
    if calibrated is not None:
        prior_sigma = float(np.hypot(calibrated, _REMOUNTED))
        if not settings.correct_ring or uncertain:
            return RingZero(0.0, min(prior_sigma, ring.sigma))
        if abs(ring.offset) <= _CONTRADICTION * np.hypot(prior_sigma, ring.sigma):
            share = prior_sigma**2 / (prior_sigma**2 + ring.sigma**2)
            return RingZero(share * ring.offset, float(np.sqrt(share) * ring.sigma), share * ring.offset)
    correctable = (
        settings.correct_ring
        and abs(ring.offset) > settings.ring_sigmas * ring.sigma
        and abs(ring.offset) <= np.radians(settings.max_ring_turn_deg)
        and not uncertain
    )
    return replace(ring, correction=ring.offset if correctable else 0.0)
