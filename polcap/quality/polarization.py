"""Gates of polarization: zero of the polarizer angles, material of the object, stray light."""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from polcap.formats.capture import angle_advice
from polcap.image_values import Bools, Floats, Quality
from polcap.optics import mueller
from polcap.optics.frames import dot, rays, total
from polcap.optics.resize import block_means, block_step
from polcap.quality import flatness, rim
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate, State, at_most, lit, sentence, worded
from polcap.quality.limits import GateLimits
from polcap.quality.rerendering import explains
from polcap.quality.shot_order import is_confirmed
from polcap.results import ResultsUntilHdr, ResultsUntilInfer, ResultsUntilSelfcal, ResultsUntilStokes
from polcap.stage_values import StokesImage, SurfaceMaps

_LEAST_RIM = 200  # pixels of outline, to estimate an angle
_LEAST_DOLP = 0.01  # of the most polarized tenth of the outline; there the least index has ten times that
_SAME_DEG = 5.0  # axes nearer than this are the same angle
_LEAST_SIGMAS = 2.5  # σ between sectors of the outline: least significance of a turn
_CERTAIN = 0.8  # of the limit of the misfit: above, also good captures fit a turn (docs/benchmarks/gates.md)
_CLEAR = 0.8  # least concentration of the AoLP about the outline, to estimate a common turn
_ALONG = -0.3  # below: the AoLP is along the contour
_DARK = 0.1  # albedo below which a glossy object shows mostly reflections of its own parts
_WEAK_DOLP = 0.05  # of an outline: above, no shape counts as flattened
_DIMMED = 0.9  # of the mean light: below, an outline turns away
_MOST_ILL_POSED = 0.15  # of the object; gloss with shadows and thin parts reaches .12 (docs/benchmarks/gates.md)
# agreement of the re-rendering from which a finding is false (docs/benchmarks/gates.md): of wax .30, under light from
# around .27, without a polarizer .04
_BODY_EXPLAINED, _UNPOLARIZED_EXPLAINED = 0.33, 0.1
_ROUGH = 0.5  # roughness from which facets alone leave little polarization
# What a finding adds to the expected error of the normals, by captures with known normals: docs/benchmarks/gates.md
_UNPOLARIZED_DEG = 11.0
_ALONG_DEG = 30.0
_TRANSLUCENT_DEG = 9.0
_LOOSE_FIT_DEG = 7.0  # 24° for shots in a wrong order, nothing for objects with sharp edges, which are usual
_NOISE = 2.0  # DoLP over its 1σ: that of noise alone is 1.2; a rough cube that faces the camera 1.3
_UNSURE_DEG = 14.0  # median expected error; beyond, correct maps of shadowed objects agree little (the same page)
_WRONG_DEG = 30.0  # mean error of the normals of captures that fail (docs/benchmarks/gates.md)
_MOST_PIXELS = 6e5  # a larger picture is averaged down


def polarized(found: Evidence[ResultsUntilInfer]) -> Iterator[Gate]:
    """Gate "polarized", only if no part of the outline is polarized.

    A plane that faces the camera is not judged if the maps explain its little polarization.
    """
    most = _most_dolp(found)
    if not most < _LEAST_DOLP:
        return
    if _is_plane(found) and found.explained > _UNPOLARIZED_EXPLAINED:
        return
    message = f"No part of the outline is polarized by more than {100 * most:.1f} %"
    remedy = "Check that the polarizer was on and turned; metal and translucent objects (wax, milk) hardly polarize"
    if found.results.radiance.equipment.angles.place == "cells":
        remedy = "Use the sensor's frames as they are, without binning or scaling; metal and wax hardly polarize"
    yield Gate("polarized", "fail", round(most, 4), _LEAST_DOLP, message, remedy, _UNPOLARIZED_DEG)


def _most_dolp(found: Evidence[ResultsUntilStokes]) -> float:
    """DoLP of the most polarized tenth of the outline; NaN for a short outline."""
    angle = found.results.selfcal.angle - found.results.selfcal.ring.correction
    band = rim.sample(*_reduce(found.results.stokes, angle))
    return rim.summarize(band, angle).dolp_most if len(band.azimuth) >= _LEAST_RIM else float("nan")


def of_outline(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Iterator[Gate]:
    """Gates on angles, material and other light, judged by the polarization along the object's outline."""
    angle, limit = found.results.selfcal.angle - found.results.selfcal.ring.correction, limits.max_turn_deg
    figures = _outline(found, limit, angle)
    if figures is None:
        yield Gate("angles", "not measured", None, limit, "The outline is too short", unit="°")
        return
    body = figures.body
    if body.dolp > 1:
        message = "The shots contradict each other: they are not of one object under one light"
        remedy = sentence(angle_advice.check_statement(found.results.radiance.equipment.angles))
        yield Gate("body", "fail", None, None, message, remedy, MOST_DEG)
        return
    of_shots = _angles(figures.turn, body, angle, found, limits)
    closed = found.results.object_.border <= limits.max_mask_border
    if of_shots.state == "fail" and not closed:  # a part of an outline can fit a turned shot by chance
        of_shots = msgspec.structs.replace(of_shots, state="warn")
    yield _with_ring(of_shots, body, found, limits)
    yield _light_of_body(body, found, limits)
    side = figures.side
    if found.results.radiance.equipment.light == "one exposure":
        yield Gate("other light", "pass", 0.0, limits.max_side_light, "All angles come from one exposure")
        return
    if body.concentration <= _CLEAR or not closed:
        message = "Polarization does not follow a closed outline in the picture"
        yield Gate("other light", "not measured", None, limits.max_side_light, message)
        return
    k = int(np.argmax(side))
    text = f"The {found.names[k]} shot is {{:.1f}} % brighter on one side than the others"
    message = worded(100 * float(side[k]), text, "No shot is brighter on one side than the others")
    remedy = "Darken the room and take that shot again: another light was on"
    yield at_most("other light", float(side[k]), limits.max_side_light, message, remedy, (found.names[k],), cost_deg=10)


@dataclass(frozen=True)
class OutlineFigures:
    """Measurements of polarization and brightness along the object's outline."""

    body: rim.RimFigures
    turn: rim.AngleError
    side: Floats  # (K,) excess brightness of one side over the other in each shot


def _outline(found: Evidence[ResultsUntilInfer], limit_deg: float, angle: Floats) -> OutlineFigures | None:
    """Measure polarization and light along the outline, for polarizer angles (K,) rad; None for a short outline.

    Angle errors smaller than `limit_deg` are not fitted.
    """
    results = found.results
    light, mask, usable = _reduce(results.stokes, angle)
    band = rim.sample(light, mask, usable)
    if len(band.azimuth) < _LEAST_RIM:
        return None
    shots, mask, usable = _reduce(results.stokes, results.selfcal.angle)  # a correction of the ring hides a turned shot
    turn = rim.fit_angle_error(rim.sample(shots, mask, usable), angle, np.radians(limit_deg))
    return OutlineFigures(rim.summarize(band, angle), turn, rim.side_light(band, angle))


def ill_posed(found: Evidence[ResultsUntilStokes], limits: GateLimits) -> Gate:
    """Gate on the share of the lit object with a polarization that no dielectric has."""
    share = _ill_posed(found)
    message = "No part looks like metal or a mirror reflection"
    if share >= 0.0005:  # less is 0.0 % in the message
        message = f"{100 * share:.1f} % of the object looks like metal or a mirror reflection"
    remedy = "Darken the room and check the angles; metal is outside the model"
    state: State = "fail" if share > _MOST_ILL_POSED else "warn"
    return at_most("ill-posed", share, limits.max_ill_posed, message, remedy, cost_deg=30 * share, beyond=state)


def _ill_posed(found: Evidence[ResultsUntilStokes]) -> float:
    """Share of the lit object with a polarization that no dielectric has."""
    inside = found.results.stokes.quality[lit(found.results.stokes)]
    return float(((inside & int(Quality.ILL_POSED)) > 0).mean()) if inside.size else 0.0


def explained_by_maps(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate on the maps: whether they explain the polarization and the brightness of the photographs."""
    seen = found.rerendered
    if not np.isfinite(seen.agreement):
        return Gate("re-rendering", "not measured", None, limits.min_rerendering_agreement, "All light is clipped")
    if seen.significance < _NOISE and _is_plane(found):
        message = "The polarization of the object is not above its noise"
        return Gate("re-rendering", "not measured", None, limits.min_rerendering_agreement, message)
    if not explains(seen, limits) and _own_error_deg(found.results.maps) > _UNSURE_DEG:
        message = "The estimator itself expects large errors, so its maps need not explain the photographs"
        return Gate("re-rendering", "not measured", None, limits.min_rerendering_agreement, message)
    value, limit = round(seen.agreement, 3), limits.min_rerendering_agreement
    message = f"Rendered again, the maps show {100 * max(seen.agreement, 0):.0f} % of the photographs' polarization"
    if explains(seen, limits):
        return Gate("re-rendering", "pass", value, limit, message)
    if seen.agreement >= limit:
        value, limit = round(seen.scale, 2), limits.max_rerendering_scale
        times, kind = max(value, 1 / value), "dark" if value > 1 else "bright"
        message = f"Rendered again, the maps are {times:.1f} times as {kind} as the photographs"
    remedy = "Compare with --estimator analytic; a model of your own may be wrong: leave out --model"
    return Gate("re-rendering", "fail", value, limit, f"{message}: the normals are wrong", remedy, _WRONG_DEG)


def _is_plane(found: Evidence[ResultsUntilInfer]) -> bool:
    """Whether the object is about one plane, which may be hardly polarized: a rounded object is, unless it is wax."""
    figures = flatness.measure(found.results.stokes, found.results.maps)
    return figures is not None and figures.one_normal


def _own_error_deg(maps: SurfaceMaps) -> float:
    """Median error of the normals that the estimator expects [degrees]."""
    return float(np.median(maps.confidence[maps.mask])) if maps.mask.any() else 0.0


def _angles(
    turn: rim.AngleError, body: rim.RimFigures, angle: Floats, found: Evidence[ResultsUntilSelfcal], limits: GateLimits
) -> Gate:
    """Gate on polarizer angles (K,) rad: on a turn of all angles, then on one of a single shot, beyond their errors."""
    limit, names, statement = limits.max_turn_deg, found.names, found.results.radiance.equipment.angles
    # true minus stated angle: an angle stated too small makes the AoLP too small
    common, sigma = -float(np.degrees(body.turned)), np.degrees(body.turned_sigma)
    reflects = abs(abs(common) - 90) <= 25  # degrees: the AoLP of reflections is turned by about 90°; see "body"
    if abs(common) > limit + 3 * sigma and body.concentration > _CLEAR and not reflects:
        message = f"All angles look turned by {common:+.0f}° ± {sigma:.0f}°"
        remedy = sentence(angle_advice.turn(statement, angle, -body.turned))
        return Gate("angles", "fail", round(common, 1), limit, message, remedy, abs(common), unit="°")
    known = found.results.selfcal.gains.source in ("grey patches", "one exposure")
    most_misfit = limits.max_turn_fit * (1.0 if known else 0.75)  # guessed gains look like turns
    if turn.misfit >= most_misfit or turn.sigmas < _LEAST_SIGMAS or turn.shot is None:
        return Gate("angles", "pass", 0.0, limit, "No other angle fits the outline clearly better", unit="°")
    degrees, remedy = float(np.degrees(turn.angle)), sentence(angle_advice.retake(statement))
    gap = np.degrees(angle[turn.shot] + turn.angle - angle)  # between the true angle of this shot and the others
    same = np.abs((gap + 90) % 180 - 90) < _SAME_DEG
    same[turn.shot] = False
    cost = abs(degrees) / 2
    if same.any():  # the pictures do not show which of the two is wrong
        shots = tuple(names[k] for k in sorted((turn.shot, int(np.argmax(same)))))
        message = f"{' and '.join(shots)} look equal, as if the polarizer was not turned between them"
        return Gate("angles", "fail", round(degrees, 1), limit, message, remedy, cost, shots, "°")
    times, name = 1 / turn.misfit, names[turn.shot]
    message = f"The {name} shot looks turned by {degrees:+.0f}°: the outline fits {times:.1f} times better"
    state: State = "fail" if turn.misfit < _CERTAIN * most_misfit else "warn"
    return Gate("angles", state, round(degrees, 1), limit, message, remedy, cost, (name,), "°")


def _with_ring(gate: Gate, body: rim.RimFigures, found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Gate:
    """Replace a passed gate of the angles by one on the zero error of the ring, common to all shots.

    The path corrects this error where it is certain. With three angles, one turned shot looks like a smaller turn of
    all, so the gate warns, if the polarization follows the outline.
    """
    selfcal, statement = found.results.selfcal, found.results.radiance.equipment.angles
    if selfcal.found_sigma is not None and gate.state == "pass":
        doubt, ring = float(np.degrees(selfcal.found_sigma)), np.degrees(selfcal.angle) % 180
        message = f"The angles were estimated: {', '.join(f'{one:.1f}°' for one in ring)} (± {doubt:.1f}°)"
        remedy = "Note the ring's mark of every shot"
        if statement.place == "cells":
            remedy = sentence(angle_advice.check_statement(statement))
        return Gate("angles", "warn", "found", "noted", message, remedy, doubt, unit="")
    turn, doubt = np.degrees([selfcal.ring.offset, selfcal.ring.sigma])
    applied = selfcal.ring.correction != 0
    noted = len(selfcal.angle) == 3 and abs(turn) > max(limits.max_ring_turn_deg, _LEAST_SIGMAS * doubt)
    noted = noted and body.concentration > _CLEAR and abs(turn) < 45  # above: reflections, see "body"
    noted = noted and found.results.radiance.equipment.light != "one exposure"  # a sensor's angles are exact
    if gate.state != "pass" or not (applied or noted):
        return gate
    message = f"The ring's zero was off by {turn:+.1f}° ± {doubt:.1f}°"
    message += ", which was corrected in all angles" if applied else ""
    value, limit = round(float(turn), 2), limits.max_ring_turn_deg
    if not noted and abs(turn) <= limits.max_turn_deg:
        return Gate("angles", "pass", value, limits.max_turn_deg, message, cost_deg=float(doubt), unit="°")
    remedy = sentence(angle_advice.turn(statement, selfcal.angle, selfcal.ring.offset))
    if noted:
        message += "; if a single shot is wrong, it is two to four times as much and not corrected"
        remedy += "; if one shot was off its mark, take it again"
    cost = float(np.hypot(turn / 2 if noted else 0, doubt))
    return Gate("angles", "warn", value, limit if noted else limits.max_turn_deg, message, remedy, cost, unit="°")


def _light_of_body(body: rim.RimFigures, found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate "body" on diffuse polarization: under a flash, a dielectric's outline is polarized across the contour.

    Rough and translucent objects both polarize little. The estimators account for roughness, so the shape of a rough
    object is as round as its shading suggests. Any other loss of polarization flattens the shape, which then does not
    explain the polarization of the whole object.
    """
    limit = limits.min_outline_dolp
    remedy = "Darken the room, keep the flash next to the lens, and photograph an ambient frame"
    zenith, roughness, albedo = _medians(found.results.maps)
    confirmed = is_confirmed(found.results.maps.order)
    if body.along < _ALONG and not (confirmed and albedo < _DARK):  # dark gloss reflects its own parts
        return _along_contour(body.along, albedo, f"{remedy}; {_across(found)}")
    if found.explained > _BODY_EXPLAINED:
        message = f"The outline is polarized by {100 * body.dolp:.1f} %, as the shape explains"
        return Gate("body", "pass", round(body.dolp, 4), limit, message)
    flat, dimmed = zenith < limits.min_zenith_deg, body.brightness < _DIMMED
    hint = "Trust the shape less: translucent objects polarize little"
    if flat and dimmed and body.dolp < max(limit, _WEAK_DOLP):
        message = (
            f"The outline is polarized by only {100 * body.dolp:.1f} % and the shape is flat (median tilt "
            f"{zenith:.0f}°), flatter than its shading: a translucent object (wax, skin, milk), or ambient light"
        )
        return Gate("body", "warn", round(zenith, 1), limits.min_zenith_deg, message, hint, _TRANSLUCENT_DEG, unit="°")
    if body.dolp < limit and (dimmed if flat else roughness < _ROUGH):
        message = (
            f"The outline is polarized by only {100 * body.dolp:.1f} %, less than gloss and shading suggest: "
            "a translucent object (wax, skin, milk), or ambient light"
        )
        return Gate("body", "warn", round(body.dolp, 4), limit, message, hint, _TRANSLUCENT_DEG)
    if body.concentration < (least := limits.min_concentration) and not confirmed:
        message = (
            f"Polarization hardly follows the outline (fit {body.concentration:.2f} of 1): ambient light, "
            "shots in a wrong order, or an object with sharp edges as outline"
        )
        return Gate("body", "warn", round(body.concentration, 2), least, message, remedy, _LOOSE_FIT_DEG, unit="")
    message = f"The outline is polarized by {100 * body.dolp:.1f} %"
    if body.dolp < limit:
        message += ", as little as a flat object" if flat else ", as little as a rough object"
    return Gate("body", "pass", round(body.dolp, 4), limit, message)


def _along_contour(along: float, albedo: float, remedy: str) -> Gate:
    """Gate "body" for an outline polarized along its contour: a warning on dark objects, a failure on brighter ones."""
    dark = albedo < _DARK
    reflects = "its own parts (dark gloss)" if dark else "light from around (metal)"
    message = (
        f"The outline is polarized along the contour: the object reflects {reflects}, or all angles are off by 90°; "
        "the pictures cannot tell which"
    )
    if dark:
        return Gate("body", "warn", round(along, 2), _ALONG, message, remedy, _LOOSE_FIT_DEG, unit="")
    return Gate("body", "fail", round(along, 2), _ALONG, message, remedy, _ALONG_DEG, unit="")


def _across(found: Evidence[ResultsUntilHdr]) -> str:
    """Advice for angles that are all off by 90°."""
    statement = found.results.radiance.equipment.angles
    if statement.place == "cells":
        return f"if the room was dark, {angle_advice.turn(statement, found.results.radiance.angle, np.pi / 2)}"
    return "if the room was dark, the ring was upright at 0°: state the angles plus 90°"


def _medians(maps: SurfaceMaps) -> tuple[float, float, float]:
    """Medians of the normals' angle from their view rays, degrees, of the roughness and of the albedo."""
    if not maps.mask.any():
        return 0.0, 0.0, 0.0
    facing = np.median(dot(maps.normal, rays(maps.view, *maps.mask.shape))[maps.mask])
    roughness, albedo = (np.median(part[maps.mask]) for part in (maps.roughness, maps.diffuse.mean(-1)))
    return float(np.degrees(np.arccos(np.clip(facing, -1, 1)))), float(roughness), float(albedo)


def _reduce(image: StokesImage, angle: Floats) -> tuple[Floats, Bools, Bools]:
    """Reduced pictures: light of the shots (K, h, w) from the Stokes parameters, object (h, w), valid pixels (h, w)."""
    step = block_step(image.mask.size, _MOST_PIXELS)
    doubtful = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST
    usable = (image.quality & int(doubtful)) == 0
    light = np.stack([block_means(part, step) for part in total(image.stokes)])
    mask, usable = (block_means(part.astype(np.float32), step) > 0.99 for part in (image.mask, usable))
    return np.einsum("kj,jhw->khw", mueller.analyzer(angle), light), mask, usable
