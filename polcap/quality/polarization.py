"""Gates of polarization: the order of the angles, their turn, and whether it is a body's light at all."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from polcap.config import Gates
from polcap.images import Floats, Quality, SelfCalibration, ShotOrder, StokesImage, SurfaceMaps, TurnedShot
from polcap.optics import mueller
from polcap.optics.frames import dot, rays, total
from polcap.quality import rim
from polcap.quality.gate import Gate, GateEvidence, at_most

_LEAST_RIM = 200  # pixels of outline that an angle can be told from
_LEAST_DOLP = 0.01  # of the outline; there the least index has ten times that
_SAME_DEG = 5.0  # axes nearer than this are the same angle
_SURE = 2.5  # σ between sectors of the outline from which a turn is believed
_CLEAR = 0.8  # concentration of the AoLP about the outline from which a common turn is believed
_LOPSIDED = 1.4  # so much more uneven may a body be that is polarized all round nearly as it should: its shape
_LIT_DOLP = 0.07  # of an outline's brighter half: above, its light is the flash's (13 with a lamp beside: up to .049)
_USUAL_DOLP = 0.1  # of an outline under a flash; a part q of it tilts by √q of the true zenith
_FLATTENED_DEG = 34.0  # of a sphere's median zenith of 45°: what the estimators do not restore (two wax-like captures)
_BALL_DEG = 45.0  # median zenith over the disc of a ball
_WEAK_DOLP = 0.05  # of an outline: above, nothing is taken for flattened; below, uneven light is no matter of shape
_DIMMED = 0.9  # of the mean light: below, an outline turns away
_ROUGH = 0.5  # roughness from which facets alone leave little polarization
_ALONG = -0.3  # how well the AoLP lies across the contour, below: along it
_MOST_PIXELS = 6e5  # a larger picture is averaged down


def order(found: GateEvidence) -> Gate:
    """Whether the outline supports the stated order and sense of the angles."""
    outline, names = found.selfcal.outline, found.names
    if outline.as_stated and outline.rival is not None:
        other = _named(outline.rival, names)
        says = f"the outline cannot tell the stated order from {other} (it fits to {outline.concentration:.2f})"
        would = "a closed, rounded object, a chart" + ("" if len(names) > 3 else " or four angles")
        remedy = f"make sure of folders and ring yourself; {would} would tell"
        return Gate("order", "warn", "cannot tell", "as stated", says, remedy, unit="")
    if outline.as_stated:
        says = f"as stated (the outline fits to {outline.concentration:.2f})"
        return Gate("order", "pass", "as stated", "as stated", says, unit="")
    best = _named(outline.best, names)
    says = f"the outline fits {best} better than the stated order"
    remedy = "name the shots by the angles they had (folders, or --angles), or take them again in order"
    return Gate("order", "fail", best, "as stated", says, remedy, 45.0, unit="")


def _named(order: ShotOrder, names: list[str]) -> str:
    return ", ".join(names[i] for i in order.shots) + (", counted the other way" if order.mirrored else "")


def of_outline(found: GateEvidence, limits: Gates) -> Iterator[Gate]:
    """What the outline says of the angles, of the body and of other light."""
    angle, limit = found.selfcal.angle - found.selfcal.ring.correction, limits.max_turn_deg
    seen = _outline(found, limit, angle)
    if seen is None:
        yield Gate("angles", "not measured", None, limit, "too little outline", unit="°")
        return
    body = seen.body
    if body.dolp < _LEAST_DOLP:
        says = f"the outline is polarized by {100 * body.dolp:.1f} %"
        remedy = "is the polarizer on, and did it turn? Metal and translucent bodies (wax, milk) hardly polarize"
        yield Gate("polarized", "fail", round(body.dolp, 4), _LEAST_DOLP, says, remedy, 45.0)
        return
    of_shots = _angles(seen.turn, body, angle, found.selfcal, found.names, limits)
    yield _with_ring(of_shots, found.selfcal, limits)
    yield _light_of_body(body, found, limits)
    side = seen.side
    k = int(np.argmax(side))
    says = f"{found.names[k]} is brighter on one side by {100 * side[k]:.1f} %"
    remedy = "another light was on in one of the shots: darken the room, and take that shot again"
    yield at_most("other light", float(side[k]), limits.max_side_light, says, remedy, (found.names[k],), 10)


@dataclass(frozen=True)
class OutlineFigures:
    """Measurements along the object's outline."""

    body: rim.Body
    turn: rim.Turn
    side: Floats  # (K,) how much brighter one side is than the other in each shot


def _outline(found: GateEvidence, limit_deg: float, angle: Floats) -> OutlineFigures | None:
    """Figures of the outline; turns below the limit are not tried; angle (K,) rad. None: it is too short."""
    band = rim.take(*_reduced(found.stokes, angle))
    if len(band.azimuth) < _LEAST_RIM:
        return None
    turn = rim.turn(band, angle, np.radians(limit_deg))
    return OutlineFigures(rim.body(band, angle), turn, rim.side_light(band))


def ill_posed(found: GateEvidence, limits: Gates) -> Gate:
    """How much of the object is polarized as no dielectric is."""
    share = _ill_posed(found)
    says = f"{100 * share:.1f} % of the object is polarized as no dielectric is"
    remedy = "ambient light, mirrored surroundings, metal, or shots out of order: darken the room, check the angles"
    return at_most("ill-posed", share, limits.max_ill_posed, says, remedy, cost_deg=30 * share)


def _ill_posed(found: GateEvidence) -> float:
    image = found.stokes
    inside = image.quality[image.mask]
    return float(((inside & int(Quality.ILL_POSED)) > 0).mean()) if inside.size else 0.0


def _angles(
    found: rim.Turn, body: rim.Body, angle: Floats, selfcal: SelfCalibration, names: list[str], limits: Gates
) -> Gate:
    """A turn of the ring, or of one shot, that outline or closure support beyond their own error."""
    limit = limits.max_turn_deg
    known = selfcal.gains.source in ("grey patches", "one exposure")
    common = -float(np.degrees(body.turned))  # an AoLP too small is an angle stated too small
    if (
        abs(common) > limit + 3 * np.degrees(body.turned_sigma)
        and body.concentration > _CLEAR
        and abs(abs(common) - 90) > 25  # light reflected off the object lies across; see "body"
    ):
        says = f"the ring looks turned by {common:+.0f}° ± {np.degrees(body.turned_sigma):.0f}° in all shots"
        remedy = "set the ring's zero to the horizontal, or name the angles it really had"
        return Gate("angles", "fail", round(common, 1), limit, says, remedy, abs(common), unit="°")
    if selfcal.turned.shots and abs(np.degrees(selfcal.turned.angle)) > limit:
        return _not_closing(selfcal.turned, names, limit)
    fit = limits.max_turn_fit * (1.0 if known else 0.75)  # guessed gains look like turns
    if found.misfit >= fit or found.sigmas < _SURE or found.shot is None:
        return Gate("angles", "pass", 0.0, limit, "no other angle fits the outline clearly better", unit="°")
    degrees = float(np.degrees(found.angle))
    gap = np.degrees(angle[found.shot] + found.angle - angle)
    same = np.abs((gap + 90) % 180 - 90) < _SAME_DEG
    same[found.shot] = False
    cost = abs(degrees) / 2
    if same.any():  # which of the two is wrong cannot be seen
        shots = tuple(names[k] for k in sorted((found.shot, int(np.argmax(same)))))
        says = f"{' and '.join(shots)} look alike: the polarizer was not turned between them"
        remedy = "turn the ring to its mark and take the shot again"
        return Gate("angles", "fail", round(degrees, 1), limit, says, remedy, cost, shots, "°")
    times = 1 / found.misfit
    says = f"{names[found.shot]} looks turned by {degrees:+.0f}°, which fits the outline {times:.1f} times better"
    remedy = "set the ring to its mark and take the shot again, or name the angle it really had"
    return Gate("angles", "fail", round(degrees, 1), limit, says, remedy, cost, (names[found.shot],), "°")


def _not_closing(turned: TurnedShot, names: list[str], limit: float) -> Gate:
    """One angle of more than three that contradicts the others over the whole object."""
    degrees, doubt = np.degrees([turned.angle, turned.sigma])
    shots = tuple(names[k] for k in turned.shots)
    which = shots[0] if len(shots) == 1 else f"{shots[0]} (or {', '.join(shots[1:])}, by as much or less)"
    says = f"{which} looks turned by {degrees:+.0f}° ± {doubt:.0f}°: the shots contradict one another"
    remedy = "set the ring to its mark and take the shot again, or name the angle it really had"
    return Gate("angles", "fail", round(float(degrees), 1), limit, says, remedy, abs(float(degrees)) / 2, shots, "°")


def _with_ring(gate: Gate, selfcal: SelfCalibration, limits: Gates) -> Gate:
    """The gate of the angles with the turn of the whole ring, taken out of them before where it was sure.

    To three angles a single shot that was turned looks like a smaller turn of all; more would not close.
    """
    if selfcal.found_sigma is not None and gate.state == "pass":
        doubt, ring = float(np.degrees(selfcal.found_sigma)), np.degrees(selfcal.angle) % 180
        says = f"nobody noted them; found {', '.join(f'{one:.1f}°' for one in ring)}, to {doubt:.1f}°"
        remedy = "note the ring's mark of every shot: then nothing has to be found"
        return Gate("angles", "warn", "found", "noted", says, remedy, doubt, unit="")
    turn, doubt = np.degrees([selfcal.ring.offset, selfcal.ring.sigma])
    applied = selfcal.ring.correction != 0
    noted = len(selfcal.angle) == 3 and abs(turn) > max(limits.max_ring_turn_deg, _SURE * doubt)
    if gate.state != "pass" or not (applied or noted):
        return gate
    says = f"the ring's zero was off by {turn:+.1f}° ± {doubt:.1f}°"
    says += ", which was taken out of all angles" if applied else ""
    value, limit = round(float(turn), 2), limits.max_ring_turn_deg
    if not noted and abs(turn) <= limits.max_turn_deg:
        return Gate("angles", "pass", value, limits.max_turn_deg, says, cost_deg=float(doubt), unit="°")
    remedy = "set the ring's zero to the horizontal, or name the angles it really had"
    if noted:
        says += "; of a single shot it would be two to four times as much, and is not mended"
        remedy += "; where one shot was off its mark, take it again"
    cost = float(np.hypot(turn / 2 if noted else 0, doubt))
    return Gate("angles", "warn", value, limit if noted else limits.max_turn_deg, says, remedy, cost, unit="°")


def _light_of_body(body: rim.Body, found: GateEvidence, limits: Gates) -> Gate:
    """Whether the outline is polarized as a body under a flash by the lens: across the contour, and enough.

    A rough body polarizes as little as a translucent one. The estimators allow for roughness, and then find a shape as
    round as shading says; what else weakens polarization is left in the shape, which is flattened.
    """
    limit = limits.min_outline_dolp
    remedy = "darken the room, keep the flash beside the lens, and photograph an ambient frame"
    if body.along < _ALONG:
        says = (
            "the outline is polarized along the contour: light from around is reflected off the object (metal, or "
            "dark gloss), or all angles are off by 90°; the pictures cannot tell these apart"
        )
        both = f"{remedy}; if it was dark, the ring's mark stood upright at 0°: name the angles as they were, 90° on"
        return Gate("body", "fail", round(body.along, 2), _ALONG, says, both, 30.0, unit="")
    weak = _FLATTENED_DEG * (1 - np.sqrt(body.dolp / _USUAL_DOLP)) if body.dolp < limit else 0.0
    if body.concentration < limits.min_concentration:
        says = (
            f"polarization hardly follows the outline ({body.concentration:.2f}): ambient light, "
            "or an object whose outline is no contour of shape"
        )
        figure, least = round(body.concentration, 2), limits.min_concentration
        return Gate("body", "warn", figure, least, says, remedy, max(15.0, weak), unit="")
    zenith, roughness = _median_shape(found.maps)
    flat, dimmed = zenith < limits.min_zenith_deg, body.brightness < _DIMMED
    hint = "under even light translucent bodies give little; trust the shape less"
    if flat and dimmed and body.dolp < max(limit, _WEAK_DOLP):
        says = (
            f"the outline is polarized by {100 * body.dolp:.1f} % and the shape found is flat ({zenith:.0f}° in the "
            "median), far less than shading says: a translucent body (wax, skin, milk), or ambient light"
        )
        cost = round(_BALL_DEG - zenith, 1)
        return Gate("body", "warn", round(zenith, 1), limits.min_zenith_deg, says, hint, cost, unit="°")
    if body.dolp < limit and (dimmed if flat else roughness < _ROUGH):
        says = (
            f"the outline is polarized by {100 * body.dolp:.1f} %, far less than gloss and shading say: a translucent "
            "body (wax, skin, milk), or ambient light"
        )
        return Gate("body", "warn", round(body.dolp, 4), limit, says, hint, round(weak, 1))
    if body.one_sided > (most := limits.max_one_sided * _lopsided(body)):
        says = f"one side of the object is lit {body.one_sided:.1f} times more than its mean: light from the side"
        return Gate("body", "warn", round(body.one_sided, 2), round(most, 2), says, remedy, 10.0, unit="")
    says = f"the outline is polarized by {100 * body.dolp:.1f} %"
    if body.dolp < limit:
        says += ": little, as a flat object's" if flat else ": little, as a rough body's"
    return Gate("body", "pass", round(body.dolp, 4), limit, says)


def _lopsided(body: rim.Body) -> float:
    """How much more uneven than the limit its light may be: other light takes polarization away where it falls."""
    if body.concentration <= _CLEAR or body.dolp_lit < _WEAK_DOLP:
        return 1.0
    return _LOPSIDED if body.dolp_lit < _LIT_DOLP else np.inf


def _median_shape(maps: SurfaceMaps) -> tuple[float, float]:
    """Median zenith of the normals, degrees from the view ray, and median roughness."""
    if not maps.mask.any():
        return 0.0, 0.0
    facing = dot(maps.normal, rays(maps.view, *maps.mask.shape))[maps.mask]
    return float(np.degrees(np.arccos(np.clip(np.median(facing), -1, 1)))), float(np.median(maps.roughness[maps.mask]))


def _reduced(image: StokesImage, angle: Floats) -> tuple[Floats, rim.Bools, rim.Bools]:
    """The shots' light (K, h, w) as solved, object and sound pixels, averaged down to _MOST_PIXELS."""
    step = int(np.ceil(np.sqrt(max(image.mask.size / _MOST_PIXELS, 1))))
    doubtful = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST
    usable = (image.quality & int(doubtful)) == 0
    light = total(image.stokes)
    mask = image.mask
    if step > 1:
        size = (mask.shape[1] // step, mask.shape[0] // step)
        cut = np.s_[: size[1] * step, : size[0] * step]
        light = np.stack([cv2.resize(part[cut], size, interpolation=cv2.INTER_AREA) for part in light])
        mask, usable = (
            cv2.resize(part[cut].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
            for part in (mask, usable)
        )
    return np.einsum("kj,jhw->khw", mueller.analyzer(angle), light), mask, usable
