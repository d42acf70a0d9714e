"""Gates of the exposures: bracket, tone curve, noise, motion, clipping, gains of the shots."""

from collections.abc import Iterator

import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.quality import flatness, gain_cost, light
from polcap.quality.gate_values import (
    DEGREES_PER_GAIN,
    Evidence,
    Gate,
    State,
    at_most,
    bad_shots,
    compared,
    grade,
    reaches,
    worded,
)
from polcap.quality.limits import GateLimits
from polcap.results import (
    ResultsUntilCues,
    ResultsUntilHdr,
    ResultsUntilInfer,
    ResultsUntilMask,
    ResultsUntilSelfcal,
    ResultsUntilStokes,
)
from polcap.stage_values import AngleStack, StokesImage

_EVEN_STEPS = (1.3, 20.0)  # from one exposure to the next: less is no bracket, more leaves a gap
# frames of a bracket count as equal if the step in pixels is below the first and in metadata above the second
_EQUAL_STEP, _STATED_STEP = 1.15, 1.4
_MISFIRE = 0.2  # change of one frame's light that fails; smaller ones are measured and corrected
_CLIPPED_HIGHLIGHTS = 0.001  # of the object: from .002 on roughness errs by .06 more (docs/benchmarks/gates.md)
_FULL = 0.95  # of the white level
_MOST_CLIPPED = 0.9975  # from here on the pictures do not show how bright the object is
_STOPS, _STOPS_PER_HALVING = 1.5, 0.75  # too bright; per halving of the unclipped share (docs/benchmarks/gates.md)
_CLIPPED_PICTURE = 0.1  # of a picture in which no object was found; a bright backdrop may clip
_MOST_MOVING = 0.5  # share of the object; moving parts do not cover more in every shot
DEGREES_PER_NOISE = 300.0  # of the normals, per unit of false DoLP
_USUAL_CHANGE = 0.02  # of the light of a shot, 1σ; the polarization of flat faces looks like 8 to 12 %
_EXPLAINED = 0.5  # agreement of the re-rendering that confirms gains: a can .84, with a chart that mirrors −.1
_GLOSS_PART = 0.3  # of the chart's gloss goes into gains taken from its light patches


def exposures(found: Evidence[ResultsUntilHdr]) -> Gate:
    """Gate on the bracket: exposure steps measured in the pixels, compared with the camera's."""
    radiance = found.results.radiance
    ratio = np.sort(radiance.bracket.exposure_ratio.mean((0, 2)))  # (E,)
    if len(ratio) == 1:
        remedy = "Shoot a bracket: it holds highlights and shadows at once"
        return Gate("exposures", "warn", 1.0, None, "One exposure per shot", remedy, unit="×")
    steps, stated, (least, most) = ratio[1:] / ratio[:-1], _stated_step(radiance), _EVEN_STEPS
    smallest, largest = float(steps.min()), float(steps.max())
    message = f"{len(ratio)} exposures per shot, {ratio[0]:.3g} to {ratio[-1]:.3g} times the reference"
    if smallest < _EQUAL_STEP and stated > _STATED_STEP:
        message = f"The frames of a bracket are equal, but the camera states steps of {stated:.2g} times"
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


def _stated_step(radiance: AngleStack) -> float:
    """Smallest ratio of successive exposures of the bracket, by metadata; NaN without metadata."""
    stated = np.sort(radiance.bracket.exif_ratio[0])
    return float((stated[1:] / stated[:-1]).min()) if np.isfinite(stated).all() and len(stated) > 1 else float("nan")


def tone(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Gate:
    """Gate on linearity of the pixel values: a tone curve makes the ratio of two exposures depend on brightness."""
    radiance = found.results.radiance
    limit = limits.max_tone_curvature
    curved = np.abs(radiance.bracket.curvature)
    within = float(np.nanmedian(np.nanmax(curved, axis=-1))) if np.isfinite(curved).any() else 0.0
    worst, reason = within, "The ratio of two exposures changes from shadows to highlights"
    power = _exposure_power(radiance)
    if radiance.equipment.light == "steady" and abs(power - 1) > worst:
        worst, reason = abs(power - 1), f"Exposures follow the stated ones to the power {power:.2f}, not 1"
    slope, color = found.results.selfcal.gains.grey_slope, found.results.color
    chart_light = color.light
    evenly = color.place is not None and (chart_light is None or chart_light.uneven < limits.max_scale_doubt / 2)
    if evenly and np.isfinite(slope) and abs(slope - 1) / 2 > worst:  # glare flattens grays too
        worst = abs(slope - 1) / 2
        reason = f"The chart's grays follow their reflectance to the power {slope:.2f}, not 1"
    message = reason if worst > limit else "Pixel values are linear"
    remedy = "Use the RAW files, or develop them linearly to 16 bits, without tone curve, denoising or lens profile"
    return at_most("tone curve", worst, limit, message, remedy, cost_deg=60 * worst, unit="")


def _exposure_power(radiance: AngleStack) -> float:
    """Exponent of measured over stated exposures: slope of their logarithms; 1 without metadata or large steps."""
    ratio = radiance.bracket.exif_ratio[0]
    stated: Floats = np.log(ratio) if np.isfinite(ratio).all() else np.zeros(1)
    measured = np.log(np.maximum(np.median(radiance.bracket.exposure_ratio.mean(2), axis=0), 1e-6))  # of most shots
    if np.ptp(stated) < 0.5 or np.ptp(measured) < 0.3:  # ln of the ratios of the brackets' ends
        return 1.0
    return float(np.polyfit(stated, measured, 1)[0])


def source(found: Evidence[ResultsUntilHdr]) -> Gate:
    """Gate on the kind of files: whether the pictures are the sensor's unprocessed counts."""
    if not found.results.radiance.sensor.lossy:
        return Gate("source", "pass", "linear counts", "linear counts", "The pictures are linear", unit="")
    message = "The pictures have 8 bits or a display encoding: rounding and tone curve add false polarization"
    remedy = "Shoot RAW"
    return Gate("source", "warn", "lossy", "linear counts", message, remedy, 5.0, unit="")


def black_level(found: Evidence[ResultsUntilHdr], limits: GateLimits) -> Gate:
    """Gate on the black level that the files state, by the exposures of the first bracket."""
    bracket, limit = found.results.radiance.bracket, limits.max_black_error
    if bracket.exposure_ratio.shape[1] == 1:
        return Gate("black level", "not measured", None, limit, "One exposure per shot does not show it")
    error = float(max(bracket.black.error, key=abs))
    message = "The exposures fit the stated black level"
    if error:
        message = f"Black is {100 * abs(error):.2g} % of the white level {'above' if error > 0 else 'below'} the stated"
        message += ", which is corrected" if bracket.black.corrected else ", or a room's light adds to the flash's"
    return at_most("black level", abs(error), limit, message, _levels_remedy(found), beyond="warn")


def _levels_remedy(found: Evidence[ResultsUntilHdr]) -> str:
    """Advice about wrong levels: only finished pictures take theirs from capture.toml."""
    sensor = found.results.radiance.sensor
    if sensor.camera_matrix is None and sensor.white_balance is None:
        return "State `black`, `white` and `encoding` of these pictures in capture.toml, or shoot RAW"
    return "Use the camera's own RAW files: converted ones state wrong levels"


def noise(found: Evidence[ResultsUntilStokes], limits: GateLimits) -> Gate:
    """Gate on noise: false polarization that noise causes in the object's median pixel."""
    figure, limit = noise_dolp(found.results.stokes), limits.max_dolp_noise
    message = worded(100 * figure, "Noise adds about {:.1f} % false polarization", "Noise adds no false polarization")
    remedy = "Use more light, a wider aperture, a longer exposure or more frames"
    cost = DEGREES_PER_NOISE * figure
    return at_most("noise", figure, limit, message, remedy, cost_deg=cost, beyond=grade(cost))


def noise_dolp(image: StokesImage) -> float:
    """False polarization that noise causes in the object's median pixel."""
    light = np.maximum(image.stokes[0][image.mask].sum(-1), 1e-9)
    # root of the mean of the variances of S1 and S2
    spread = np.sqrt((image.covariance[3] + image.covariance[5])[image.mask].sum(-1) / 2)
    return float(np.median(spread / light)) if len(light) else float("nan")


def stillness(found: Evidence[ResultsUntilMask], limits: GateLimits) -> Gate:
    """Gate on motion within a bracket: share of the object that differs between the exposures of a shot."""
    ghost = (found.results.radiance.quality & int(Quality.GHOST)) > 0
    mask = found.results.object_.mask
    fraction = ghost[:, mask].mean(1) if mask.any() else np.zeros(len(ghost))
    k = int(np.argmax(fraction))
    text = f"{{:.2f}} % of the object differs between the exposures of the {found.names[k]} shot"
    message = worded(100 * float(fraction[k]), text, "The exposures of every shot show the same")
    remedy = "Take the bracket again: something moved, or the light changed"
    bad, blurred = (
        bad_shots(found.names, fraction > limits.max_ghost),
        np.nan_to_num(found.blur_px) > limits.max_blur_px,
    )
    if blurred.any() and limits.max_ghost < fraction[k] <= _MOST_MOVING:
        return Gate("stillness", "not judged", None, None, "The gate 'sharpness' leaves nothing to judge here", unit="")
    if rescue := leave_out(found, np.asarray(blurred), limits):  # it shows something else, not less sharp
        remedy = f"{rescue}; or take the bracket again: a frame shows something else"
    if _has_wrong_levels(found.results.radiance, fraction, limits):
        message += ": their black level, white level or encoding is not as stated"
        remedy, bad = _levels_remedy(found), ()
    return at_most("stillness", float(fraction[k]), limits.max_ghost, message, remedy, bad, cost_deg=5)


def _has_wrong_levels(radiance: AngleStack, ghost: Floats, limits: GateLimits) -> bool:
    """Whether wrong levels or an encoding explain the share of ghosts of each shot (K,), rather than motion."""
    bracket = radiance.bracket
    black = bool(bracket.black.error.any()) and not bracket.black.corrected
    curved = np.nanmax(np.abs(np.nan_to_num(bracket.curvature)), axis=1) > limits.max_tone_curvature
    return black or bool((ghost > _MOST_MOVING).all() or ((ghost > _MOST_MOVING) & curved).any())


def leave_out(found: Evidence[ResultsUntilHdr], bad: Bools, limits: GateLimits) -> str:
    """Advice to leave out the exposure of the bracket that has all bad frames (K, E); empty if there is none.

    The darkest exposure that remains must hold the object's highlights.
    """
    columns = np.flatnonzero(bad.any(axis=0))
    count = bad.shape[1]
    if len(columns) != 1 or count < 2 or not found.files:
        return ""
    rest = [e for e in range(count) if e != columns[0]]
    radiance = found.results.radiance
    ratio = radiance.bracket.exposure_ratio  # (K, E, 3)
    darkest = min(rest, key=lambda e: float(ratio[:, e].mean()))
    everywhere = np.ones(radiance.value.shape[1:3], bool)
    inside = found.results.object_.mask if reaches(found, ResultsUntilMask) else everywhere
    full = (radiance.value[:, inside] * ratio[:, darkest, None]).max(2) > _FULL  # (K, N)
    if full.mean(1).max() > limits.max_clipped:
        return ""
    names = ", ".join(files[columns[0]] for files in found.files)
    return f"Move {names} out of the folder: the same exposure of every shot, without which the others suffice"


def clipping(found: Evidence[ResultsUntilHdr], limits: GateLimits) -> Gate:
    """Gate on the share of the object that is clipped in the shortest exposure; of the picture without an object."""
    where, limit, clipped = "picture", _CLIPPED_PICTURE, found.clipped.reshape(*found.clipped.shape[:2], -1)
    if known := reaches(found, ResultsUntilMask):
        where, limit, clipped = "object", limits.max_clipped, found.clipped[:, :, found.results.object_.mask]
    shares = clipped.mean(2).min(1)  # (K,)
    share, few = float(shares.max()), min(_CLIPPED_HIGHLIGHTS, limits.max_clipped)
    name, stops = found.names[int(np.argmax(shares))], _stops_too_bright(share)
    text = f"{{:.1f}} % of the {where} is clipped in the shortest exposure of the {name} shot"
    message = worded(100 * share, text, f"No part of the {where} is clipped in the shortest exposures")
    remedy = (
        f"Shoot again with {stops} stop{'s' * (stops > 1)} less light (1/{2**stops} of it), or add an exposure that is "
        "darker by as much to every bracket"
    )
    if share > limit and (shares <= few).sum() > 1:  # the others are exposed well
        remedy = "Take that shot again with as much light as the others had"
    if known and few < share <= limit:
        message += ": highlights, without which roughness and specular are uncertain"
        return at_most("clipping", share, few, message, remedy, bad_shots(found.names, shares > few), beyond="warn")
    return at_most("clipping", share, limit, message, remedy, bad_shots(found.names, shares > limit), 20 * share)


def _stops_too_bright(share: float) -> int:
    """Whole stops of light to take away, so that of a clipped `share` only highlights stay clipped."""
    return int(np.ceil(_STOPS - _STOPS_PER_HALVING * np.log2(1 - min(share, _MOST_CLIPPED))))


def gains(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Iterator[Gate]:
    """Gates on flash energy: shot against shot, uncertainty of that gain, frame against bracket."""
    measured, radiance, names = found.results.selfcal.gains, found.results.radiance, found.names
    shot = measured.gain.mean(1)
    light = shot[:, None] * radiance.bracket.exposure_ratio.mean(2)  # (K, E)
    relative = light / np.median(light, axis=0) - 1
    each = np.median(relative, axis=1)  # (K,) change of each shot's light
    limit = limits.max_gain_change
    brighter = each > limit  # it may show another lamp, which no gain corrects
    k = int(np.argmax(np.where(brighter.any() & ~brighter, 0, np.abs(each))))
    remedy = "Wait longer between flashes: this one misfired or had not recycled"
    if radiance.equipment.light == "steady":
        remedy = "Shoot again under constant light: the lamp or daylight changed between shots"
    message = f"The {names[k]} shot was {compared(each[k], 'the others')}"
    message += ", which is corrected" if -each[k] > limit else ""
    bad = bad_shots(names, brighter if brighter.any() else -each > limit)
    state: State = "fail" if brighter.any() else "warn"
    yield at_most("gains", float(abs(each[k])), limit, message, remedy, bad, 3 if each[k] > 0 else 0, beyond=state)
    yield gain_doubt(found, limits)
    drift = relative - each[:, None]
    k, e = (int(i) for i in np.unravel_index(int(np.argmax(np.abs(drift))), drift.shape))
    limit = limits.max_energy_drift
    change = float(drift[k, e])
    message = f"Frame {e + 1} of {names[k]} was {compared(change, 'its bracket')}"
    bad = bad_shots(names, np.abs(drift).max(1) > limit)
    remedy = remedy.replace("between shots", "within a bracket")
    if rescue := leave_out(found, np.abs(drift) > limit, limits):
        remedy = f"{rescue}. {remedy}"
    yield at_most(
        "energy", abs(change), limit, message, remedy, bad, beyond="fail" if abs(change) > _MISFIRE else "warn"
    )


def gain_doubt(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Gate:
    """Gate on the uncertainty of the shots' gains."""
    measured, limit, contradicted = found.results.selfcal.gains, limits.max_gain_doubt, False
    if measured.source == "one exposure":
        return Gate("gain doubt", "pass", 0.0, limit, "All angles come from one exposure")
    doubt = float(measured.sigma.mean(1).max())
    if measured.source == "grey patches" and max(doubt, gloss := _GLOSS_PART * measured.chart_gloss) <= limit:
        gap, limit = measured.disagreement, limits.max_gain_disagreement
        message = f"Gray patches and object agree on the light of each shot (1σ {100 * doubt:.2f} %)"
        explained = reaches(found, ResultsUntilInfer) and found.explained > _EXPLAINED
        if gap > limit and (explained or _has_sharp_edges(found)):
            message = (
                f"Gray patches give the light of each shot (1σ {100 * doubt:.2f} %); the object does not confirm it"
            )
            return Gate("gain doubt", "pass", doubt, limits.max_gain_doubt, message)
        if gap > limit:
            message = f"Gray patches and object disagree by {100 * gap:.1f} % on a shot's light, beyond their errors"
        remedy = "Turn the chart to the camera, and light it as the object"
        return at_most("gain doubt", gap, limit, message, remedy, cost_deg=_cost_deg(found, gap))
    if measured.source == "grey patches" and gloss > limit:
        doubt, message = gloss, f"The chart is glossy: its gloss changes the gains by up to {100 * gloss:.1f} %"
        remedy = "Turn the chart until it mirrors neither flash nor window, or use a matte one"
    elif measured.source == "grey patches":
        message = f"The chart's gray patches give the light of each shot only within {100 * doubt:.1f} % (1σ)"
        remedy = "Show the whole gray row of the chart, evenly lit, or use --no-chart"
    else:
        doubt, message = _doubt_without_grays(found, doubt)
        if contradicted := measured.source == "object" and light.contradicts_gains(found, limits):
            doubt = max(doubt, float(np.abs(np.log(measured.gain)).max()))
            message = f"The object shows changes of the light by up to {100 * doubt:.1f} %, its surroundings show none"
        if measured.source == "none":
            message = f"The light of each shot is unknown; it is assumed equal within {100 * doubt:.1f} % (1σ)"
        remedy = "Put a ColorChecker next to the object"
        if found.results.color.place is not None:
            message = (
                f"The chart moved or its gray patches are hidden: the light is known within {100 * doubt:.1f} % (1σ)"
            )
            remedy = "Fix the chart next to the object, with the whole gray row lit evenly"
        remedy += "" if found.results.radiance.equipment.light == "steady" else ", or use a steady lamp"
        remedy += "" if len(found.names) > 3 else ", or shoot four angles"
    cost = _cost_of_equal_light(found, doubt) if contradicted else _cost_deg(found, doubt)
    state: State = "fail" if cost > limits.max_normal_error_deg else "warn"
    return at_most("gain doubt", doubt, limit, message, remedy, cost_deg=cost, beyond=state)


def _doubt_without_grays(found: Evidence[ResultsUntilSelfcal], doubt: float) -> tuple[float, str]:
    """1σ of the least known gain from the object, and the finding in words.

    Flat faces do not show the light of the shots, which is then assumed equal, as far as the surroundings confirm it:
    wrong gains polarize all of them.
    """
    if doubt > _USUAL_CHANGE and _has_sharp_edges(found):
        polarized = light.surroundings_dolp(found, found.results.selfcal.gains.gain)
        doubt = min(doubt, float(np.fmax(_USUAL_CHANGE, polarized)))
        message = "Without gray patches flat faces do not show the light of each shot; it is assumed equal within "
        return doubt, f"{message}{100 * doubt:.0f} % (1σ)"
    return doubt, f"Without gray patches the light of each shot is known within {100 * doubt:.1f} % (1σ)"


def _cost_of_equal_light(found: Evidence[ResultsUntilSelfcal], doubt: float) -> float:
    """Error of the normals [degrees] if all shots had equal light, as the surroundings show."""
    if not reaches(found, ResultsUntilCues):
        return DEGREES_PER_GAIN * doubt
    pixels = found.results.cues.ratio[:, found.results.cues.mask]
    change = np.log(found.results.selfcal.gains.gain.mean(1))
    return gain_cost.other_gains_deg(pixels, found.results.selfcal.angle, change)


def _cost_deg(found: Evidence[ResultsUntilSelfcal], doubt: float) -> float:
    """Error of the normals [degrees] if the least known gain has the 1σ `doubt`, and the others in proportion."""
    if not reaches(found, ResultsUntilCues):  # the pixels' polarization is unknown
        return DEGREES_PER_GAIN * doubt
    sigma = found.results.selfcal.gains.sigma.mean(1)
    if not sigma.max() > 0:
        sigma = np.where(np.arange(len(sigma)) > 0, 1.0, 0.0)  # relative to the first shot
    pixels = found.results.cues.ratio[:, found.results.cues.mask]
    return gain_cost.normal_error_deg(pixels, found.results.selfcal.angle, doubt * sigma / sigma.max())


def _has_sharp_edges(found: Evidence[ResultsUntilSelfcal]) -> bool:
    """Whether sharp edges of flat faces make the outline: then its polarization does not show the shots' light."""
    if not reaches(found, ResultsUntilInfer):
        return False
    figures = flatness.measure(found.results.stokes, found.results.maps)
    return figures is not None and figures.sharp_edged
