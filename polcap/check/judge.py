"""A reduced capture in, the lines of its verdict out: each stage of the path, and what its result must keep to."""

from collections.abc import Iterator
from typing import Literal

import msgspec
import numpy as np

from polcap.check import rim, sharpness
from polcap.check.reduced import Taken
from polcap.config import Config
from polcap.errors import ChartError, InputError
from polcap.formats import calib
from polcap.images import (
    Alignment,
    AngleStack,
    Capture,
    ChartRequest,
    ColorCalibration,
    Floats,
    Gains,
    Network,
    ObjectMask,
    Quality,
    StokesImage,
)
from polcap.optics import mueller
from polcap.stages import align, cues, hdr, infer, mask, selfcal, stokes, whitebalance

_LEAST_RIM = 200  # pixels of outline that an angle can be told from
_LEAST_DOLP = 0.01  # of the outline; there the least index has ten times that
_SAME_DEG = 5.0  # axes nearer than this are the same angle
_EVEN_STEPS = (1.3, 20.0)  # from one exposure to the next: less is no bracket, more leaves a gap


State = Literal["ok", "warning", "reshoot", "not measured"]


UNITS = {"exposures": " times", "alignment": " px", "sharpness": " px", "angles": "°", "normals": "°"}  # else shares


class Line(msgspec.Struct, frozen=True):
    """One figure and what it means."""

    name: str
    state: State
    figure: float | None  # in UNITS
    limit: float | None
    says: str
    remedy: str = ""  # where it is not ok
    shots: tuple[str, ...] = ()  # to be taken again


def lines(taken: Taken, network: Network | None, mask_network: Network | None, config: Config) -> Iterator[Line]:
    """The figures in the order of the path; where a stage gives up, its error is the last line."""
    capture, gates = taken.capture, config.gates
    names = [shot.name for shot in capture.shots]
    stage = "exposures"
    try:
        motion = max(config.hdr.max_motion_px / taken.step, 1.0)
        radiance = hdr.merge(capture, msgspec.structs.replace(config.hdr, max_motion_px=motion))
        yield _exposures(capture, radiance)
        color, line = _chart(radiance, config)
        yield line
        stage = "alignment"
        free = msgspec.structs.replace(config.align, max_shift_px=500.0, min_correlation=0.0)
        alignment = align.register(radiance, color, free)
        moved = _alignment(alignment, radiance, taken, config, names)
        yield moved
        stage = "object"
        object_ = mask.segment(radiance, alignment, color, None, mask_network, config.mask)
        yield _clipping(taken, object_, gates.max_clipped, names)
        yield _sharpness(taken, config.check.max_blur_px, names, moved)
        stage = "order"
        unchecked = msgspec.structs.replace(config.selfcal, check_order=False)
        gains = selfcal.solve(radiance, alignment, object_, color, unchecked)
        yield from _energy(gains, radiance, config, names)
        ordered = _order(gains, names)
        yield ordered
        if ordered.state == "reshoot":
            return  # in another order all that follows is another capture's
        stage = "angles"
        image = stokes.solve(radiance, alignment, gains, object_, config.stokes)
        yield from _outline(image, radiance, config, names)
        stage = "normals"
        yield _ghosts(radiance, gates.max_ghost, names)
        yield from _ambient(capture, radiance, object_, config.check.max_ambient)
        maps = infer.estimate(cues.compute(image, color), network, config.infer)
        error = float(np.median(maps.confidence[maps.mask]))
        remedy = "more light or frames, four angles, or a darker room"
        yield _least("normals", error, gates.max_normal_error_deg, f"expected error {error:.1f}° (median)", remedy)
    except InputError as error:
        yield Line(stage, "reshoot", None, None, str(error), "as it says; what comes after it could not be measured")


def _least(
    name: str,
    figure: float,
    limit: float,
    says: str,
    remedy: str,
    shots: tuple[str, ...] = (),
    state: State = "reshoot",
) -> Line:
    """A figure that must not exceed its limit."""
    if not np.isfinite(figure):
        return Line(name, "not measured", None, limit, says)
    if figure <= limit:
        return Line(name, "ok", round(figure, 5), limit, says)
    return Line(name, state, round(figure, 5), limit, says, remedy, shots)


def _exposures(capture: Capture, radiance: AngleStack) -> Line:
    """The bracket as the pixels tell it."""
    ratio = np.sort(radiance.exposure_ratio.mean((0, 2)))  # (E,)
    if len(ratio) == 1:
        return Line("exposures", "warning", None, None, "1 per shot", "a bracket holds highlights and shadows at once")
    steps = ratio[1:] / ratio[:-1]
    says = f"{len(ratio)} per shot, {ratio[0]:.3g} : 1 : {ratio[-1]:.3g}"
    least, most = _EVEN_STEPS
    if steps.min() < least:
        return Line("exposures", "warning", round(float(steps.min()), 3), least, says, "two exposures are alike")
    if steps.max() > most:
        remedy = "a gap between two exposures: shoot one between"
        return Line("exposures", "warning", round(float(steps.max()), 3), most, says, remedy)
    return Line("exposures", "ok", round(float(steps.max()), 3), most, says)


def _chart(radiance: AngleStack, config: Config) -> tuple[ColorCalibration, Line]:
    """The colours; without a chart the rest can still be judged."""
    reference = calib.colorchecker()
    try:
        color = whitebalance.measure(radiance, reference, ChartRequest("auto"), config.whitebalance)
        return color, Line("chart", "ok", None, None, "found")
    except ChartError:
        remedy = "let it be seen whole, or give --chart or --no-chart to `polcap process`"
        color = whitebalance.measure(radiance, reference, ChartRequest("none"), config.whitebalance)
        return color, Line("chart", "warning", None, None, "not found", remedy)


def _alignment(found: Alignment, radiance: AngleStack, taken: Taken, config: Config, names: list[str]) -> Line:
    """How far the camera or the object moved from shot to shot; in pixels of the picture that is processed."""
    grid = taken.step / (taken.tile_px if config.hdr.demosaic == "superpixel" else 1)
    height, width = radiance.value.shape[1:3]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    at = found.transform @ corners  # (K, 3, 4)
    shift = np.abs(at[:, :2] / at[:, 2:] - corners[:2]).max((1, 2)) * grid
    limit = config.align.max_shift_px
    lost = (found.correlation < config.align.min_correlation) | ~np.isfinite(shift)
    unsure = found.residual_px * grid > config.gates.max_align_residual_px * max(grid, 1)
    bad = lost | (shift > limit) | unsure
    worst = int(np.argmax(np.where(bad, 1e9, 0) + shift))
    says = f"{names[worst]} moved by {shift[worst]:.1f} px, sure to {found.residual_px[worst] * grid:.2f}"
    if lost[worst]:
        says = f"{names[worst]} shows another scene, or moved too far to be followed"
    remedy = "lock the camera, do not touch the object, and take that shot again" if bad.any() else ""
    shots = tuple(name for name, one in zip(names, bad) if one)
    return Line("alignment", "reshoot" if remedy else "ok", round(float(shift[worst]), 3), limit, says, remedy, shots)


def _clipping(taken: Taken, object_: ObjectMask, limit: float, names: list[str]) -> Line:
    share = taken.clipped[:, :, object_.mask].mean(2)  # (K, E)
    least = share.min(1)  # in the shot's shortest exposure
    worst = int(np.argmax(least))
    says = (
        f"{100 * least[worst]:.1f} % of the object in the shortest exposure of {names[worst]}, "
        f"{100 * share.max():.0f} % in the longest"
    )
    shots = tuple(name for name, one in zip(names, least) if one > limit)
    return _least("clipping", float(least[worst]), limit, says, "add a darker frame, or less flash", shots)


def _sharpness(taken: Taken, limit: float, names: list[str], moved: Line) -> Line:
    """Every frame against the frames of the same exposure in the other shots."""
    if moved.figure is None or moved.figure > sharpness.TILE / 2:
        return Line("sharpness", "not measured", None, limit, "the shots show different places")
    blur = np.stack(
        [
            taken.tile_px * sharpness.extra_blur(taken.tiles[:, e], taken.tiles_usable[:, e])
            for e in range(taken.tiles.shape[1])
        ],
        axis=1,
    )  # (K, E) RAW px
    if np.isnan(blur).all():
        return Line("sharpness", "not measured", None, limit, "too little bright detail")
    k, e = np.unravel_index(int(np.nanargmax(blur)), blur.shape)
    says = f"{names[k]} frame {e + 1} blurred by {blur[k, e]:.1f} px beyond the sharpest"
    shots = tuple(name for name, one in zip(names, np.nanmax(blur, axis=1, initial=0)) if one > limit)
    remedy = "focus by hand and tape the ring, use a remote release, then take it again"
    return _least("sharpness", float(blur[k, e]), limit, says, remedy, shots)


def _energy(gains: Gains, radiance: AngleStack, config: Config, names: list[str]) -> Iterator[Line]:
    """The light of every frame against the same frame of the other shots."""
    light = gains.gain.mean(1)[:, None] * radiance.exposure_ratio.mean(2)  # (K, E)
    off = light / np.median(light, axis=0) - 1
    shot = np.median(off, axis=1)
    k = int(np.argmax(np.abs(shot)))
    limit = config.check.max_gain_change
    shots = tuple(name for name, one in zip(names, shot) if abs(one) > limit)
    remedy = "the flash misfired or had not recycled: wait longer between pops"
    yield _least("gains", float(abs(shot[k])), limit, f"{names[k]} {100 * shot[k]:+.1f} %", remedy, shots)
    drift = off - shot[:, None]
    k, e = (int(i) for i in np.unravel_index(int(np.argmax(np.abs(drift))), drift.shape))
    limit = config.check.max_energy_drift
    shots = tuple(name for name, one in zip(names, np.abs(drift).max(1)) if one > limit)
    says = f"{names[k]} frame {e + 1} {100 * drift[k, e]:+.1f} % against its bracket"
    remedy = "the flash's energy wandered within a bracket: wait longer between pops"
    yield _least("energy", float(abs(drift[k, e])), limit, says, remedy, shots)


def _order(gains: Gains, names: list[str]) -> Line:
    if gains.order == tuple(range(len(names))) and not gains.mirrored:
        return Line("order", "ok", None, None, f"as stated (the outline fits to {gains.concentration:.2f})")
    best = ", ".join(names[i] for i in gains.order) + (", counted the other way" if gains.mirrored else "")
    remedy = "name the shots by the angles they had (folders, or --angles), or take them again in order"
    return Line("order", "reshoot", None, None, f"the outline fits {best} better than the stated order", remedy)


def _outline(image: StokesImage, radiance: AngleStack, config: Config, names: list[str]) -> Iterator[Line]:
    """What the outline says of the angles and of other light."""
    light = np.einsum("kj,jhw->khw", mueller.analyzer(radiance.angle), image.stokes.sum(-1))
    doubtful = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST
    band = rim.take(light, image.mask, (image.quality & int(doubtful)) == 0)
    limit = config.check.max_turn_deg
    if band.length < _LEAST_RIM:
        yield Line("angles", "not measured", None, limit, "too little outline")
        return
    dolp = float(np.median(rim.dolp(band, radiance.angle)))
    if dolp < _LEAST_DOLP:
        remedy = "is the polarizer on, and did it turn? A metal object has no diffuse polarization"
        yield Line(
            "polarized", "reshoot", round(dolp, 4), _LEAST_DOLP, f"outline polarized by {100 * dolp:.1f} %", remedy
        )
        return
    found = rim.turn(band, radiance.angle, np.radians(limit))
    if found.misfit < config.check.max_turn_fit:
        yield _turned(found, radiance.angle, limit, names)
    else:
        yield Line("angles", "ok", 0.0, limit, "no other angle fits the outline clearly better")
    side = rim.side_light(band)
    k = int(np.argmax(side))
    limit = config.check.max_side_light
    remedy = "another light was on in one of the shots: darken the room, and take that shot again"
    says = f"{names[k]} brighter on one side by {100 * side[k]:.1f} %"
    yield _least("other light", float(side[k]), limit, says, remedy, (names[k],))


def _turned(found: rim.Turn, angle: Floats, limit: float, names: list[str]) -> Line:
    degrees = float(np.degrees(found.angle))
    remedy = "set the ring to its mark and take the shot again, or name the angle it really had"
    which = "the ring"
    shots: tuple[str, ...] = ()
    if found.shot is not None:
        which, shots = names[found.shot], (names[found.shot],)
        gap = np.degrees(angle[found.shot] + found.angle - angle)
        same = np.abs((gap + 90) % 180 - 90) < _SAME_DEG
        same[found.shot] = False
        if same.any():  # which of the two is wrong cannot be seen
            shots = tuple(names[k] for k in sorted((found.shot, int(np.argmax(same)))))
            says = f"{' and '.join(shots)} look alike: the polarizer was not turned between them"
            return Line("angles", "reshoot", round(degrees, 1), limit, says, remedy, shots)
    says = f"{which} looks turned by {degrees:+.0f}°, which fits the outline {1 / found.misfit:.1f} times better"
    return Line("angles", "reshoot", round(degrees, 1), limit, says, remedy, shots)


def _ghosts(radiance: AngleStack, limit: float, names: list[str]) -> Line:
    k = int(np.argmax(radiance.ghost_fraction))
    figure = float(radiance.ghost_fraction[k])
    shots = tuple(name for name, one in zip(names, radiance.ghost_fraction) if one > limit)
    remedy = "something moved or the light changed within a bracket: take it again"
    return _least(
        "stillness", figure, limit, f"{100 * figure:.2f} % of {names[k]} differs between exposures", remedy, shots
    )


def _ambient(capture: Capture, radiance: AngleStack, object_: ObjectMask, limit: float) -> Iterator[Line]:
    """The share of ambient light, where it was photographed."""
    shares = []
    for k, shot in enumerate(capture.shots):
        ratio = radiance.exposure_ratio[k].mean(-1)
        reference = shot.frames[int(np.argmin(np.abs(ratio - 1)))].exif.relative_exposure or 1.0
        lit = float(np.mean(radiance.value[k][object_.mask]))
        for frame in shot.ambient:
            dark = float(np.mean(frame.load().value[object_.mask]))
            shares.append(dark * reference / (frame.exif.relative_exposure or reference) / max(lit, 1e-9))
    if shares:
        share = float(np.mean(shares))
        remedy = "darken the room: what is left of ambient light turns polarization"
        yield _least("ambient", share, limit, f"{100 * share:.1f} % of the object's light", remedy)
