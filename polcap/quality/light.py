"""Gates of the light: bracket, tone curve, chart, gains, clipping, ambient light."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from polcap.images import AngleStack, Floats, Quality, StokesImage
from polcap.optics import mueller
from polcap.optics.frames import dot, rays
from polcap.optics.morphology import erode
from polcap.optics.resize import block_means
from polcap.quality.gate import DEGREES_PER_GAIN, Evidence, Gate, State, at_most, bad_shots
from polcap.quality.limits import GateLimits
from polcap.stages.whitebalance import patches

_EVEN_STEPS = (1.3, 20.0)  # from one exposure to the next: less is no bracket, more leaves a gap
# frames of a bracket count as equal if the step in pixels is below the first and in metadata above the second
_ALIKE, _PROMISED = 1.15, 1.4
_TURNED = 0.35  # rad: the message states larger turns of a chart, which cost a sixteenth of its light
_BRIGHTER = 1.08  # times S0: the greatest that scale and registration explain; set by hand
_EDGE_PX = 2.0  # 1σ of the blur before two shots are compared, so that misaligned edges of a print do not count
_STILL_CLIPPED = 0.5  # share of highlights that a crossed filter should have stopped
_FEW = 20  # px
_MISFIRE = 0.2  # change of one frame's light that fails; smaller ones are measured and corrected
_CLIPPED_HIGHLIGHTS = 0.001  # of the object: from .002 on roughness errs by .06 more (docs/benchmarks/gates.md)
_DEGREES_PER_AMBIENT = 12.0  # of the normals, with one ambient frame for all angles: 1 to 2° at 15 %
_LEAST_ALBEDO = 0.02  # sum of the channels
_TOWARDS_CAMERA = float(np.cos(np.radians(30)))  # cosine; lamps 45° to the side are mirrored at 22°
_LEAST_TOWARDS = 0.02  # of the object
_DEGREES_PER_ROOT_OF_HIGHLIGHT_DOLP = 30.0  # of the normals: 2 to 4° at 1 %, 4 to 8° at 2 %, 2 to 11° at 3 to 15 %
_FALSE_HIGHLIGHT_DOLP = 0.002  # under one flash: up to .0025 (24 captures)
_ROOM_TILE, _LEAST_ROOM_TILES = 16, 20  # px; tiles
_WITH_FRAME = 1.5  # size of a chart with its frame over the size of its patches
_DEGREES_PER_ROOM_DOLP = 50.0  # of the normals: 1.3 to 2.6° at 5.5 % (docs/benchmarks/gates.md)
_GLOSS_PART = 0.3  # of the chart's gloss goes into gains taken from its light patches


def bracket(found: Evidence) -> Gate:
    """Gate on the bracket: exposure steps measured in the pixels, compared with the camera's."""
    radiance = found.radiance
    ratio = np.sort(radiance.bracket.exposure_ratio.mean((0, 2)))  # (E,)
    if len(ratio) == 1:
        remedy = "Shoot a bracket: it holds highlights and shadows at once"
        return Gate("exposures", "warn", 1.0, None, "One exposure per shot", remedy, unit="×")
    steps, promised, (least, most) = ratio[1:] / ratio[:-1], _promised_steps(radiance), _EVEN_STEPS
    smallest, largest = float(steps.min()), float(steps.max())
    message = f"{len(ratio)} exposures per shot, {ratio[0]:.3g} to {ratio[-1]:.3g} times the reference"
    if smallest < _ALIKE and promised > _PROMISED:
        message = f"The frames of a bracket are equal, but the camera states steps of {promised:.2g} times"
        remedy = "Bracket by flash power, aperture or ISO: shutter time does not change a flash exposure"
        if radiance.equipment.light == "steady":
            remedy = f"Was a flash on? {remedy}"
    elif smallest < least:
        message += "; two of them are nearly equal"
        remedy = "Change flash power, aperture or ISO; under a steady lamp, the shutter time"
    elif largest > most:
        message += "; the step between two of them is too large"
        return Gate("exposures", "warn", round(largest, 3), most, message, "Shoot an exposure in between", unit="×")
    else:
        return Gate("exposures", "pass", round(largest, 3), most, message, unit="×")
    return Gate("exposures", "warn", round(smallest, 3), least, message, remedy, unit="×")


def tone(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on linearity of the pixel values: a tone curve makes the ratio of two exposures depend on brightness."""
    radiance = found.radiance
    limit = limits.max_tone_curvature
    curved = np.abs(radiance.bracket.curvature)
    within = float(np.nanmedian(np.nanmax(curved, axis=-1))) if np.isfinite(curved).any() else 0.0
    worst, reason = within, "The ratio of two exposures changes from shadows to highlights"
    power = _exposure_power(radiance)
    if radiance.equipment.light == "steady" and abs(power - 1) > worst:
        worst, reason = abs(power - 1), f"Exposures follow the stated ones to the power {power:.2f}, not 1"
    slope, chart_light = found.selfcal.gains.grey_slope, found.color.light
    evenly = found.color.place is not None and (chart_light is None or chart_light.uneven < limits.max_scale_doubt / 2)
    if evenly and np.isfinite(slope) and abs(slope - 1) / 2 > worst:  # glare flattens grays too
        worst = abs(slope - 1) / 2
        reason = f"The chart's grays follow their reflectance to the power {slope:.2f}, not 1"
    message = reason if worst > limit else "Pixel values are linear"
    remedy = "Use the RAW files, or develop them linearly to 16 bits, without tone curve, denoising or lens profile"
    return at_most("tone curve", worst, limit, message, remedy, cost_deg=60 * worst, unit="")


def source(found: Evidence) -> Gate:
    """Gate on the kind of files: whether the pictures are the sensor's unprocessed counts."""
    if not found.radiance.sensor.lossy:
        return Gate("source", "pass", "linear counts", "linear counts", "The pictures are linear", unit="")
    message = "The pictures have 8 bits or a display encoding: rounding and tone curve add false polarization"
    remedy = "Shoot RAW"
    return Gate("source", "warn", "lossy", "linear counts", message, remedy, 5.0, unit="")


def noise(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on noise: false polarization that noise causes in the object's median pixel."""
    figure, limit = _noise(found.stokes), limits.max_dolp_noise
    message = f"Noise adds about {100 * figure:.1f} % false polarization"
    remedy = "Use more light, a wider aperture, a longer exposure or more frames"
    return at_most("noise", figure, limit, message, remedy, cost_deg=300 * figure)


def _noise(image: StokesImage) -> float:
    light = np.maximum(image.stokes[0][image.mask].sum(-1), 1e-9)
    spread = np.sqrt((image.covariance[3] + image.covariance[5])[image.mask].sum(-1) / 2)
    return float(np.median(spread / light)) if len(light) else float("nan")


def stillness(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on motion within a bracket: share of the object that differs between the exposures of a shot."""
    ghost = (found.radiance.quality & int(Quality.GHOST)) > 0
    fraction = ghost[:, found.object_.mask].mean(1) if found.object_.mask.any() else np.zeros(len(ghost))
    k = int(np.argmax(fraction))
    message = f"{100 * fraction[k]:.2f} % of the object differs between the exposures of the {found.names[k]} shot"
    remedy = "Take the bracket again: something moved, or the light changed"
    bad = bad_shots(found.names, fraction > limits.max_ghost)
    blurred = np.nan_to_num(found.blur_px).max() > limits.max_blur_px  # `sharpness` judges this
    state: State = "warn" if blurred else "fail"
    return at_most(
        "stillness", float(fraction[k]), limits.max_ghost, message, remedy, bad, 1 if blurred else 5, beyond=state
    )


def chart(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on the chart: whether it was found, and the mean color error of its patches."""
    limit = limits.max_delta_e
    if found.chart_missing and found.later_view:
        message = "This view shows no chart; `polcap fuse` takes the colors of the view that does"
        return Gate("chart", "not measured", None, limit, message, unit="ΔE2000")
    if found.chart_missing:
        remedy = (
            "Shoot again with the whole chart visible and lit, or name its corners with --chart; with --no-chart "
            "colors come from the camera's profile and the scale of albedo is unknown"
        )
        message = f"No chart was found ({found.chart_missing}); `polcap process` needs a chart or --no-chart"
        return Gate("chart", "warn", None, limit, message, remedy, unit="ΔE2000")
    colors = found.color.patches
    if colors is None:
        return Gate("chart", "not measured", None, limit, "No chart was used", unit="ΔE2000")
    mean = float(np.nanmean(colors.delta_e))
    where = "" if found.color.place else " in the capture that shows it"
    message = f"Chart colors match within ΔE {mean:.1f}{where}"
    if colors.predicted is not None:
        message += f" ({float(np.nanmean(colors.predicted)):.1f} when cross-checked)"
    if colors.use is not None and colors.use.any():
        message += f"; {patches.left_out(colors.use)}"
    if found.color.light is not None and found.color.light.tilt > _TURNED:
        message += f"; it is turned by {np.degrees(found.color.light.tilt):.0f}° from the lens, which is corrected"
    if found.radiance.sensor.lossy:
        message += "; the pictures have 8 bits or a tone curve, which no color matrix can undo"
    remedy = "Light the chart as the object, without glare, or name its corners with --chart"
    return at_most("chart", mean, limit, message, remedy, unit="ΔE2000")


def albedo_scale(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on the common scale of all albedos: its uncertainty; without a chart the scale is unknown."""
    sigma, limit, source = found.maps.albedo_sigma, limits.max_scale_doubt, found.color.source
    if found.chart_missing and found.later_view:
        message = "The view that shows the chart gives the albedos of this view their scale"
        return Gate("albedo scale", "not measured", None, limit, message)
    of_session = source == "profile" and sigma is not None
    put = "In the view that shows the ColorChecker, put it" if of_session else "Put a ColorChecker"
    remedy = f"{put} next to the middle of the object, facing the lens, where only the flash lights it"
    if sigma is None:
        message = "The albedos are relative: without a chart in the picture their scale is unknown"
        if source == "profile":
            message = "The albedos are relative: a color profile holds their scale only under the light of its capture"
        return Gate("albedo scale", "warn", "relative", "known", message, remedy, unit="")
    message = f"All albedos share an error of scale of {100 * sigma:.0f} % (1σ)"
    light = found.color.light
    if sigma > limit and light is not None and light.uneven > limit / 2:
        message += ": the chart is lit unevenly, by another lamp or through a lens that darkens the corners"
    elif sigma > limit:
        message += ": they are higher than usual, as of a very bright object or a chart with less light"
    return at_most("albedo scale", sigma, limit, message, remedy, beyond="warn")


def clipping(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on the share of the object that is clipped in the shortest exposure."""
    clipped, limit = found.clipped[:, :, found.object_.mask].mean(2).min(1), limits.max_clipped
    share, few = float(clipped.max()), min(_CLIPPED_HIGHLIGHTS, limits.max_clipped)
    name = found.names[int(np.argmax(clipped))]
    message = f"{100 * share:.1f} % of the object is clipped in the shortest exposure of the {name} shot"
    remedy = "Add a darker exposure or use less light"
    if few < share <= limit:
        message += ": highlights, without which roughness and specular are uncertain"
        return at_most("clipping", share, few, message, remedy, bad_shots(found.names, clipped > few), beyond="warn")
    return at_most("clipping", share, limit, message, remedy, bad_shots(found.names, clipped > limit), 20 * share)


def gains(found: Evidence, limits: GateLimits) -> Iterator[Gate]:
    """Gates on flash energy: shot against shot, uncertainty of that gain, frame against bracket."""
    measured, radiance, names = found.selfcal.gains, found.radiance, found.names
    shot = measured.gain.mean(1)
    light = shot[:, None] * radiance.bracket.exposure_ratio.mean(2)  # (K, E)
    off = light / np.median(light, axis=0) - 1
    each = np.median(off, axis=1)
    k = int(np.argmax(np.abs(each)))
    limit = limits.max_gain_change
    remedy = "Wait longer between flashes: this one misfired or had not recycled"
    if radiance.equipment.light == "steady":
        remedy = "Shoot again under constant light: the lamp or daylight changed between shots"
    message = f"The {names[k]} shot was {abs(100 * each[k]):.1f} % {_comparative(each[k])} than the others"
    yield at_most("gains", float(abs(each[k])), limit, message, remedy, bad_shots(names, np.abs(each) > limit), 3)
    yield _gain_doubt(found, limits)
    drift = off - each[:, None]
    k, e = (int(i) for i in np.unravel_index(int(np.argmax(np.abs(drift))), drift.shape))
    limit = limits.max_energy_drift
    change = float(drift[k, e])
    message = f"Frame {e + 1} of {names[k]} was {abs(100 * change):.1f} % {_comparative(change)} than its bracket"
    bad = bad_shots(names, np.abs(drift).max(1) > limit)
    remedy = remedy.replace("between shots", "within a bracket")
    yield at_most(
        "energy", abs(change), limit, message, remedy, bad, beyond="fail" if abs(change) > _MISFIRE else "warn"
    )


def _comparative(change: float) -> str:
    return "darker" if change < 0 else "brighter"


def _gain_doubt(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on the uncertainty of the shots' gains."""
    measured, limit = found.selfcal.gains, limits.max_gain_doubt
    if measured.source == "one exposure":
        return Gate("gain doubt", "pass", 0.0, limit, "All angles come from one exposure")
    doubt = float(measured.sigma.mean(1).max())
    if measured.source == "grey patches" and max(doubt, gloss := _GLOSS_PART * measured.chart_gloss) <= limit:
        gap, limit = measured.disagreement, limits.max_gain_disagreement
        message = f"Gray patches and object agree on the light of each shot (1σ {100 * doubt:.2f} %)"
        if gap > limit:
            message = f"Gray patches and object disagree by {100 * gap:.1f} % on a shot's light, beyond their errors"
        remedy = "Turn the chart to the camera, and light it as the object"
        return at_most("gain doubt", gap, limit, message, remedy, cost_deg=DEGREES_PER_GAIN * gap)
    if measured.source == "grey patches" and gloss > limit:
        doubt, message = gloss, f"The chart is glossy: its gloss changes the gains by up to {100 * gloss:.1f} %"
        remedy = "Turn the chart until it mirrors neither flash nor window, or use a matte one"
    elif measured.source == "grey patches":
        message = f"The chart's gray patches give the light of each shot only within {100 * doubt:.1f} % (1σ)"
        remedy = "Show the whole gray row of the chart, evenly lit, or use --no-chart"
    else:
        message = f"Without gray patches the light of each shot is known within {100 * doubt:.1f} % (1σ)"
        if measured.source == "none":
            message = f"The light of each shot is unknown; it is assumed equal within {100 * doubt:.1f} % (1σ)"
        remedy = "Put a ColorChecker next to the object"
        remedy += "" if found.radiance.equipment.light == "steady" else ", or use a steady lamp"
        remedy += "" if len(found.names) > 3 else ", or shoot four angles"
    cost = DEGREES_PER_GAIN * doubt
    return at_most("gain doubt", doubt, limit, message, remedy, cost_deg=cost, beyond=_grade(cost))


def _grade(cost_deg: float) -> State:
    return "fail" if cost_deg > 15 else "warn"


def crossed(found: Evidence, limits: GateLimits) -> Iterator[Gate]:
    """Gates on the cross-polarized shot: it must be darker than S0, and not clipped where S0 is."""
    if found.radiance.crossed is None:
        return
    limit = limits.max_crossed_misfit
    remedy = "Set the lens's filter to the stated angle and turn the flash's filter until the highlights vanish"
    if found.stokes.body is None:
        message = "The brightness of the cross-polarized shot relative to the others is unknown; it is not used"
        yield Gate("crossed", "warn", None, limit, message, "Put a ColorChecker next to the object, or expose more")
        return
    seen = _compare_crossed(found.stokes)
    share = 100 * seen.mirrored
    message = f"{share:.1f} % of the object's light is mirrored at its surface; it is removed from the albedo"
    if seen.left > _STILL_CLIPPED and seen.clipped > _FEW:
        message = f"{100 * seen.left:.0f} % of the clipped highlights are also clipped in the cross-polarized shot"
        yield Gate("crossed", "warn", round(seen.left, 3), _STILL_CLIPPED, message, remedy)
        return
    if seen.over > limit:
        message = f"{100 * seen.over:.0f} % of the object is brighter in the cross-polarized shot than is possible"
    yield at_most("crossed", seen.over, limit, message, remedy, beyond="warn")


@dataclass(frozen=True)
class CrossedFigures:
    """Comparison of the cross-polarized shot with S0."""

    left: float  # share of the clipped highlights of S0 that are clipped in the crossed shot too
    clipped: int  # number of clipped pixels of S0
    over: float  # share of pixels that are brighter in the crossed shot than in S0, which is not possible
    mirrored: float  # share of the object's light that the crossed filter removes: specular reflection


def _compare_crossed(image: StokesImage) -> CrossedFigures:
    """Compare the cross-polarized shot with S0."""
    assert image.body is not None
    known = image.mask & (image.body.quality == 0)
    sound = known & ((image.quality & int(Quality.CLIPPED)) == 0)
    total, body = image.stokes[0].sum(-1), image.body.value.sum(-1)
    clipped = image.mask & ((image.quality & int(Quality.CLIPPED)) > 0)
    left = float((clipped & ~known).sum() / max(clipped.sum(), 1))
    weight = sound.astype(np.float32)
    smooth, whole = (cv2.GaussianBlur(part * weight, (0, 0), _EDGE_PX) for part in (body, total))
    inner = erode(sound, 2)
    over = float((smooth > _BRIGHTER * whole)[inner].mean()) if inner.any() else 1.0
    mirrored = float(np.maximum(total - body, 0)[sound].sum() / max(float(total[sound].sum()), 1e-9))
    return CrossedFigures(left, int(clipped.sum()), over, mirrored)


def ambient(found: Evidence, limits: GateLimits) -> Gate:
    """Gate on the share of ambient light; it is measured only if frames without flash were taken.

    The object polarizes the room's light too. Only an ambient frame at the same angle contains the same light.
    """
    bracket, limit = found.radiance.bracket, limits.max_ambient
    if not np.isfinite(bracket.ambient_share).any():
        return Gate("ambient", "not measured", None, limit, "No frame was taken without the flash")
    worst = float(np.nanmax(bracket.ambient_share))
    message = f"{100 * worst:.1f} % of the light does not come from the flash; the ambient frames are subtracted"
    cost = round(_DEGREES_PER_AMBIENT * worst, 1) if bracket.ambient_shared else 0.0
    if bracket.ambient_shared and limits.max_ambient_shared < worst <= limit:
        limit = limits.max_ambient_shared
        message = f"{100 * worst:.1f} % of the light is the room's, and one ambient frame serves several angles"
        remedy = "Darken the room, or take one ambient frame per angle: subtracting them is exact"
        return Gate("ambient", "warn", round(worst, 5), limit, message, remedy, cost)
    remedy = "Darken the room: the noise and changes of so much ambient light remain"
    return msgspec.structs.replace(at_most("ambient", worst, limit, message, remedy), cost_deg=cost)


def polarized_light(found: Evidence, limits: GateLimits) -> Iterator[Gate]:
    """Gates on light from elsewhere than a flash at the lens: polarization that many pixels share.

    "room light" judges the surroundings of the object. A flash leaves them unpolarized, a window or a glossy lamp does
    not. "lighting" judges the brightest of the parts that face the camera, relative to albedo. Under a flash at the
    lens their polarization points in all directions. Two flashes or softboxes at the sides polarize them in the same
    direction.
    """
    share, limit = _surroundings_dolp(found), limits.max_room_dolp
    message = f"The surroundings are polarized by {100 * share:.1f} %"
    if share > limit:
        message += ": polarized light from the room, or glossy surroundings"
    remedy = "Darken the room, or take one ambient frame per angle: subtracting them is exact"
    yield at_most("room light", share, limit, message, remedy, cost_deg=_DEGREES_PER_ROOM_DOLP * share, beyond="warn")
    share, limit = _highlight_dolp(found), limits.max_highlight_dolp
    message = f"The brightest parts that face the camera share a polarization of {100 * share:.1f} %"
    if share > limit:
        message += ": light from the sides (two flashes, softboxes, a window), which bends normals and roughness"
    remedy = "Use one flash next to the lens, and darken the room"
    cost = float(_DEGREES_PER_ROOT_OF_HIGHLIGHT_DOLP * np.sqrt(max(np.nan_to_num(share) - _FALSE_HIGHLIGHT_DOLP, 0.0)))
    gate = at_most("lighting", share, limit, message, remedy, beyond=_grade(cost))
    yield msgspec.structs.replace(gate, cost_deg=round(cost, 1))


def _highlight_dolp(found: Evidence) -> float:
    """Common DoLP of the tenth of the surfaces that face the camera with most light over albedo.

    Highlights of lamps at the sides are there, too. NaN if too little of the object faces the camera.
    """
    maps, both = found.maps, found.maps.mask & found.cues.mask
    towards = both & (dot(maps.normal, rays(maps.view, *maps.mask.shape)) > _TOWARDS_CAMERA)
    if not towards.any() or towards.sum() < _LEAST_TOWARDS * both.sum():
        return float("nan")
    light = found.cues.radiance[towards].sum(-1) / np.maximum(maps.diffuse[towards].sum(-1), _LEAST_ALBEDO)
    bright = light >= np.percentile(light, 90)
    return float(np.hypot(*np.median(found.cues.ratio[:, towards][:, bright], axis=1)))


def _surroundings_dolp(found: Evidence) -> float:
    """Common DoLP of the surroundings, without object and chart: median of tiles; NaN for too few tiles."""
    radiance = found.radiance
    outside = (radiance.quality & int(Quality.CLIPPED) == 0).all(0) & ~found.object_.mask
    if found.color.place is not None:
        middle = found.color.place.corners.mean(0)
        frame = middle + _WITH_FRAME * (found.color.place.corners - middle)
        outside &= cv2.fillConvexPoly(np.zeros(outside.shape, np.uint8), frame.astype(np.int32), 1) == 0
    clear = block_means(outside, _ROOM_TILE) > 0.999
    if clear.sum() < _LEAST_ROOM_TILES:
        return float("nan")
    shots = zip(radiance.value, found.selfcal.gains.gain)
    light = [block_means(shot, _ROOM_TILE)[clear] @ (1 / gain) for shot, gain in shots]
    s0, s1, s2 = np.linalg.lstsq(mueller.analyzer(found.selfcal.angle), np.stack(light), rcond=None)[0]
    return float(np.hypot(np.median(s1 / np.maximum(s0, 1e-9)), np.median(s2 / np.maximum(s0, 1e-9))))


def _promised_steps(radiance: AngleStack) -> float:
    """Smallest ratio of successive exposures of the bracket, by metadata; NaN without metadata."""
    stated = np.sort(radiance.bracket.exif_ratio[0])
    return float((stated[1:] / stated[:-1]).min()) if np.isfinite(stated).all() and len(stated) > 1 else float("nan")


def _exposure_power(radiance: AngleStack) -> float:
    """Power law between measured and stated exposures: slope of their logarithms; 1 without metadata or steps."""
    ratio = radiance.bracket.exif_ratio[0]
    stated: Floats = np.log(ratio) if np.isfinite(ratio).all() else np.zeros(1)
    seen = np.log(np.maximum(radiance.bracket.exposure_ratio.mean((0, 2)), 1e-6))
    if np.ptp(stated) < 0.5 or np.ptp(seen) < 0.3:
        return 1.0
    return float(np.polyfit(stated, seen, 1)[0])
