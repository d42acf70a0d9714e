"""Gates of the light: bracket, tone curve, chart, gains, clipping, ambient light."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from polcap.config import Gates
from polcap.images import AngleStack, Floats, Quality, StokesImage
from polcap.quality.gate import DEGREES_PER_GAIN, Evidence, Gate, State, at_most, blamed
from polcap.stages.whitebalance import patches

_EVEN_STEPS = (1.3, 20.0)  # from one exposure to the next: less is no bracket, more leaves a gap
_ALIKE = 1.15  # steps in the pixels below this, where the metadata promise more than _PROMISED, are none
_PROMISED = 1.4
_TURNED = 0.35  # rad, from here on a chart's turn is worth a word: a sixteenth of its light
_BRIGHTER = 1.08  # times S0: the greatest that scale and registration explain; set by hand
_EDGE_PX = 2.0  # 1σ over which two shots are compared: edges of a print need not meet
_STILL_CLIPPED = 0.5  # share of highlights that a crossed filter should have stopped
_FEW = 20  # px
_GLOSS_PART = 0.3  # of the chart's gloss goes into gains taken from its light patches


def bracket(found: Evidence) -> Gate:
    """The bracket as the pixels tell it, and where that is not what the camera promises, why."""
    radiance = found.radiance
    ratio = np.sort(radiance.bracket.exposure_ratio.mean((0, 2)))  # (E,)
    if len(ratio) == 1:
        says = "one exposure per shot"
        return Gate("exposures", "warn", 1.0, None, says, "a bracket holds highlights and shadows at once", unit="×")
    steps = ratio[1:] / ratio[:-1]
    says = f"{len(ratio)} per shot, {ratio[0]:.3g} … {ratio[-1]:.3g} of the reference"
    least, most = _EVEN_STEPS
    promised = _promised_steps(radiance)
    if steps.min() < _ALIKE and promised > _PROMISED:
        says = f"frames of a bracket are alike, though the camera states steps of {promised:.2g} times"
        remedy = "shutter time does not change a flash exposure: bracket by flash power, aperture or ISO"
        if radiance.equipment.light == "steady":
            remedy = "was a flash on? Shutter time does not change its exposure: bracket by power, aperture or ISO"
        return Gate("exposures", "warn", round(float(steps.min()), 3), least, says, remedy, unit="×")
    if steps.min() < least:
        remedy = "two exposures are alike: change flash power, aperture or ISO, or under a steady lamp the shutter"
        return Gate("exposures", "warn", round(float(steps.min()), 3), least, says, remedy, unit="×")
    if steps.max() > most:
        remedy = "a gap between two exposures: shoot one between"
        return Gate("exposures", "warn", round(float(steps.max()), 3), most, says, remedy, unit="×")
    return Gate("exposures", "pass", round(float(steps.max()), 3), most, says, unit="×")


def tone(found: Evidence, limits: Gates) -> Gate:
    """Whether the pixels are linear: a tone curve changes the ratio of two exposures with brightness."""
    radiance = found.radiance
    limit = limits.max_tone_curvature
    curved = np.abs(radiance.bracket.curvature)
    within = float(np.nanmedian(np.nanmax(curved, axis=-1))) if np.isfinite(curved).any() else 0.0
    worst, how = within, "the ratio of two exposures changes from shadows to highlights"
    power = _power(radiance)
    if radiance.equipment.light == "steady" and abs(power - 1) > worst:
        worst, how = abs(power - 1), f"exposures change as the stated ones to the power {power:.2f}"
    slope = found.selfcal.gains.grey_slope if found.color.place is not None else float("nan")
    if np.isfinite(slope) and abs(slope - 1) / 2 > worst:  # glare flattens greys too
        worst, how = abs(slope - 1) / 2, f"the chart's greys follow their reflectance to the power {slope:.2f}"
    says = how if worst > limit else "linear"
    remedy = (
        "a tone curve (a camera's JPEG, or a RAW developed by hand): give the RAW files, or develop linearly to "
        "16 bits without curve, denoising or lens profile"
    )
    return at_most("tone curve", worst, limit, says, remedy, cost_deg=60 * worst, unit="")


def source(found: Evidence) -> Gate:
    """Whether the pictures are the sensor's own counts."""
    if not found.radiance.sensor.lossy:
        return Gate(
            "source", "pass", "linear counts", "linear counts", "the sensor's counts, or linear pictures", unit=""
        )
    says = "8-bit or display-encoded pictures: rounding and the camera's rendering stand for polarization"
    remedy = "shoot RAW"
    return Gate("source", "warn", "lossy", "linear counts", says, remedy, 5.0, unit="")


def noise(found: Evidence, limits: Gates) -> Gate:
    """The polarization that noise alone fakes, in the object's median pixel."""
    figure, limit = _noise(found.stokes), limits.max_dolp_noise
    says = f"noise fakes a polarization of {100 * figure:.1f} % in the median pixel of the object"
    remedy = "too dark: more light, a wider aperture, a longer exposure, or more frames"
    return at_most("noise", figure, limit, says, remedy, cost_deg=300 * figure)


def _noise(image: StokesImage) -> float:
    light = np.maximum(image.stokes[0][image.mask].sum(-1), 1e-9)
    spread = np.sqrt((image.covariance[3] + image.covariance[5])[image.mask].sum(-1) / 2)
    return float(np.median(spread / light)) if len(light) else float("nan")


def stillness(found: Evidence, limits: Gates) -> Gate:
    """How much of a shot differs between its exposures."""
    fraction = found.radiance.bracket.ghost_fraction
    k = int(np.argmax(fraction))
    says = f"{100 * fraction[k]:.2f} % of {found.names[k]} differs between exposures"
    remedy = "something moved or the light changed within a bracket: take it again"
    bad = blamed(found.names, fraction > limits.max_ghost)
    return at_most("stillness", float(fraction[k]), limits.max_ghost, says, remedy, bad, cost_deg=5)


def chart(found: Evidence, limits: Gates) -> Gate:
    """How well the chart's colors are met, where there is one."""
    limit = limits.max_delta_e
    if found.chart_missing:
        remedy = (
            "shoot it again with the chart seen whole and lit, or give process its corners with --chart; with "
            "--no-chart colours and scale come from the camera alone"
        )
        says = f"no chart found ({found.chart_missing}): `polcap process` asks for one, or for --no-chart"
        return Gate("chart", "warn", None, limit, says, remedy, unit="ΔE2000")
    colors = found.color.patches
    if colors is None:
        return Gate("chart", "not measured", None, limit, "none was asked for", unit="ΔE2000")
    mean = float(np.nanmean(colors.delta_e))
    says = f"its colours are met to ΔE {mean:.1f}"
    if colors.predicted is not None:
        says += f", to {float(np.nanmean(colors.predicted)):.1f} where a patch is left out of the fit"
    if colors.use is not None and colors.use.any():
        says += f"; {patches.left_out(colors.use)}"
    if found.color.light is not None and found.color.light.tilt > _TURNED:
        says += f"; it is turned by {np.degrees(found.color.light.tilt):.0f}° from the lens, which the scale takes out"
    if found.radiance.sensor.lossy:
        says += "; the pictures have 8 bits or a camera's rendering, which a matrix cannot undo"
    remedy = "light the chart as the object, without glare, or give its corners with --chart"
    return at_most("chart", mean, limit, says, remedy, unit="ΔE2000")


def clipping(found: Evidence, limits: Gates) -> Gate:
    """How much of the object is clipped even in the shortest exposure."""
    # of the darkest frame
    clipped, limit = found.clipped[:, :, found.object_.mask].mean(2).min(1), limits.max_clipped
    k = int(np.argmax(clipped))
    says = f"{100 * clipped[k]:.1f} % of the object is clipped even in the shortest exposure of {found.names[k]}"
    remedy = "add a darker frame, or less light: nothing is known of clipped pixels"
    return at_most(
        "clipping", float(clipped[k]), limit, says, remedy, blamed(found.names, clipped > limit), 20 * float(clipped[k])
    )


def gains(found: Evidence, limits: Gates) -> Iterator[Gate]:
    """The light of every frame against the others', and how far that is known."""
    measured, radiance, names = found.selfcal.gains, found.radiance, found.names
    shot = measured.gain.mean(1)
    light = shot[:, None] * radiance.bracket.exposure_ratio.mean(2)  # (K, E)
    off = light / np.median(light, axis=0) - 1
    each = np.median(off, axis=1)
    k = int(np.argmax(np.abs(each)))
    limit = limits.max_gain_change
    why = "the flash misfired or had not recycled: wait longer between pops"
    if radiance.equipment.light == "steady":
        why = "the lamp or the daylight changed between shots: let it settle, and shoot again"
    says = f"the light of {names[k]} was {100 * each[k]:+.1f} % of the other shots'"
    yield at_most("gains", float(abs(each[k])), limit, says, why, blamed(names, np.abs(each) > limit), 3)
    yield _gain_doubt(found, limits)
    drift = off - each[:, None]
    k, e = (int(i) for i in np.unravel_index(int(np.argmax(np.abs(drift))), drift.shape))
    limit = limits.max_energy_drift
    says = f"frame {e + 1} of {names[k]} {100 * drift[k, e]:+.1f} % against its bracket"
    bad = blamed(names, np.abs(drift).max(1) > limit)
    yield at_most("energy", float(abs(drift[k, e])), limit, says, why.replace("between shots", "within a bracket"), bad)


def _gain_doubt(found: Evidence, limits: Gates) -> Gate:
    """How far the gains themselves are to be trusted."""
    measured = found.selfcal.gains
    limit = limits.max_gain_doubt
    if measured.source == "one exposure":
        return Gate("gain doubt", "pass", 0.0, limit, "one exposure: one gain")
    doubt = float(measured.sigma.mean(1).max())
    if measured.source == "grey patches":
        gloss = _GLOSS_PART * measured.chart_gloss
        if gloss > limit:
            says = (
                f"the chart shines: its dark patches are polarized, which bends the gains by up to {100 * gloss:.1f} %"
            )
            remedy = "turn the chart so that it mirrors neither flash nor window, or use a matt one"
            cost = DEGREES_PER_GAIN * gloss
            return at_most("gain doubt", gloss, limit, says, remedy, cost_deg=cost, beyond=_grade(cost))
        if doubt > limit:
            says = f"the chart's grey patches give the light of the shots to {100 * doubt:.1f} % only (1σ)"
            remedy = "show the whole grey row of the chart, evenly lit, or use --no-chart"
            cost = DEGREES_PER_GAIN * doubt
            return at_most("gain doubt", doubt, limit, says, remedy, cost_deg=cost, beyond=_grade(cost))
        gap, limit = measured.disagreement, limits.max_gain_disagreement
        says = f"grey patches and object agree on the light of the shots (1σ {100 * doubt:.2f} %)"
        if gap > limit:
            says = f"grey patches and object differ by {100 * gap:.1f} % on a shot's light, beyond the error of both"
        remedy = "was the chart lit and seen as the object is, and unpolarized? Turn it to the camera"
        return at_most("gain doubt", gap, limit, says, remedy, cost_deg=DEGREES_PER_GAIN * gap)
    cost = DEGREES_PER_GAIN * doubt
    says = f"no grey patches: the light of the shots is known to {100 * doubt:.1f} % (1σ)"
    if measured.source == "none":
        says = f"nothing tells the light of the shots: taken as equal, to {100 * doubt:.1f} % (1σ)"
    ways = ["put a ColorChecker beside the object"]
    ways += [] if found.radiance.equipment.light == "steady" else ["use a steady lamp"]
    ways += [] if len(found.names) > 3 else ["shoot four angles"]
    remedy = " or ".join(ways)
    return at_most("gain doubt", doubt, limit, says, remedy, cost_deg=cost, beyond=_grade(cost))


def _grade(cost_deg: float) -> State:
    return "fail" if cost_deg > 15 else "warn"


def crossed(found: Evidence, limits: Gates) -> Iterator[Gate]:
    """Whether the cross-polarised shot shows what it should: less light than S0, and nothing clipped where S0 clips."""
    if found.radiance.crossed is None:
        return
    limit = limits.max_crossed_misfit
    remedy = (
        "turn the flash's filter until the highlights vanish, lens's filter at the angle stated; same place, same chart"
    )
    if found.stokes.body is None:
        says = "nothing tells how bright the cross-polarised shot is against the others: it is not used"
        yield Gate("crossed", "warn", None, limit, says, "put a ColorChecker beside the object, or expose it more")
        return
    seen = _crossed(found.stokes)
    share = 100 * seen["mirrored"]
    says = f"{share:.1f} % of the object's light is mirrored at its surface, and taken out of its albedo"
    if seen["left"] > _STILL_CLIPPED and seen["clipped"] > _FEW:
        says = f"{100 * seen['left']:.0f} % of the clipped highlights are clipped in the cross-polarised shot too"
        yield Gate("crossed", "warn", round(seen["left"], 3), _STILL_CLIPPED, says, remedy)
        return
    if seen["over"] > limit:
        says = f"{100 * seen['over']:.0f} % of the object is brighter in the cross-polarised shot than light allows"
    yield at_most("crossed", seen["over"], limit, says, remedy, beyond="warn")


def _crossed(image: StokesImage) -> dict[str, Any]:
    """Shares of what is clipped in it too, of what is brighter than S0, and of the light that it lacks."""
    assert image.body is not None
    known = image.mask & (image.body.quality == 0)
    sound = known & ((image.quality & int(Quality.CLIPPED)) == 0)
    total, body = image.stokes[0].sum(-1), image.body.value.sum(-1)
    clipped = image.mask & ((image.quality & int(Quality.CLIPPED)) > 0)
    left = float((clipped & ~known).sum() / max(clipped.sum(), 1))
    weight = sound.astype(np.float32)
    smooth, whole = (cv2.GaussianBlur(part * weight, (0, 0), _EDGE_PX) for part in (body, total))
    inner = cv2.erode(sound.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    over = float((smooth > _BRIGHTER * whole)[inner].mean()) if inner.any() else 1.0
    mirrored = float(np.maximum(total - body, 0)[sound].sum() / max(float(total[sound].sum()), 1e-9))
    return {"left": left, "clipped": int(clipped.sum()), "over": over, "mirrored": mirrored}


def ambient(found: Evidence, limits: Gates) -> Gate:
    """The share of ambient light, where it was photographed."""
    share = found.radiance.bracket.ambient_share
    limit = limits.max_ambient
    if not np.isfinite(share).any():
        return Gate("ambient", "not measured", None, limit, "no frame was taken without the flash")
    worst = float(np.nanmax(share))
    says = f"{100 * worst:.1f} % of the light is there without the flash"
    remedy = "darken the room: what is left of ambient light turns polarization"
    return at_most("ambient", worst, limit, says, remedy, cost_deg=60 * worst)


def _promised_steps(radiance: AngleStack) -> float:
    """Least step of the bracket as the metadata tell it; NaN where they do not."""
    stated = np.sort(radiance.bracket.exif_ratio[0])
    return float((stated[1:] / stated[:-1]).min()) if np.isfinite(stated).all() and len(stated) > 1 else float("nan")


def _power(radiance: AngleStack) -> float:
    """Slope of ln measured over ln stated exposure; 1 where the metadata are silent, or state no steps."""
    ratio = radiance.bracket.exif_ratio[0]
    stated: Floats = np.log(ratio) if np.isfinite(ratio).all() else np.zeros(1)
    seen = np.log(np.maximum(radiance.bracket.exposure_ratio.mean((0, 2)), 1e-6))
    if np.ptp(stated) < 0.5 or np.ptp(seen) < 0.3:
        return 1.0
    return float(np.polyfit(stated, seen, 1)[0])
