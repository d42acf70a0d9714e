"""Gates of the light: chart, scale of albedo, cross-polarized shot, ambient light, light from the sides."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from polcap.image_values import Floats, Quality
from polcap.optics import mueller
from polcap.optics.frames import dot, rays
from polcap.optics.morphology import erode
from polcap.optics.resize import block_means
from polcap.optics.robust import MEDIAN_SE
from polcap.quality import albedo_slope
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate, at_most, grade, worded
from polcap.quality.limits import GateLimits
from polcap.results import (
    ResultsUntilHdr,
    ResultsUntilInfer,
    ResultsUntilSelfcal,
    ResultsUntilStokes,
    ResultsUntilWhitebalance,
)
from polcap.stage_values import StokesImage
from polcap.stages.whitebalance import patches

_TURNED = 0.35  # rad: the message states larger turns of a chart, which cost a sixteenth of its light
_BRIGHTER = 1.08  # times S0: the greatest that scale and registration explain; set by hand
_EDGE_PX = 2.0  # 1σ of the blur before two shots are compared, so that misaligned edges of a print do not count
_STILL_CLIPPED = 0.5  # share of highlights that a crossed filter should have stopped
_FEW = 20  # px: fewer clipped ones are not judged
_DEGREES_PER_AMBIENT = 12.0  # of the normals, with one ambient frame for all angles: 1 to 2° at 15 %
_UNLIKE = 4.0  # ratio of the room's light in two ambient frames that a polarization of 60 % causes: 1.6 / 0.4
_LEAST_AMBIENT = 0.02  # share of the light: less is not compared between the angles
_DEGREES_PER_UNLIKE = 80.0  # of the normals: 12° at a gap of .15 between the shares
_DEGREES_PER_FLICKER = 400.0  # of the normals: 4.3 and 7.3° at 1.2 and 3.6 % of the light (docs/benchmarks/gates.md)
_LEAST_ALBEDO = 0.02  # sum of the channels
_TOWARDS_CAMERA = float(np.cos(np.radians(30)))  # cosine; lamps 45° to the side are mirrored at 22°
_LEAST_TOWARDS = 0.12  # of the object: five bodies from .18, boxes and cans mostly below
_LEAST_FACING = 500  # px, a tenth of which is judged
_ONE_WAY = 0.7  # 0…1, of the facing normals: bodies up to .46, with softboxes .65, cans up to .9 (bench_flat.py)
_DEGREES_PER_ROOT_OF_HIGHLIGHT_DOLP = 30.0  # of the normals: 2 to 4° at 1 %, 4 to 8° at 2 %, 2 to 11° at 3 to 15 %
_ONE_FLASH = "Use one flash next to the lens, leave it where it is, and darken the room"
_SIDES = ("right", "upper right", "top", "upper left", "left", "lower left", "bottom", "lower right")
_LEANING = np.pi / 6  # the message compares parts that lean by this angle to both sides
_LAMP_DEG, _DEGREES_PER_ALBEDO_SLOPE = 4.0, 2.5  # of the normals: 2 to 7° with a lamp, 4 to 10° with two softboxes
_FALSE_HIGHLIGHT_DOLP = 0.002  # under one flash: up to .0025 (24 captures)
_ROOM_TILE, _LEAST_ROOM_TILES = 16, 20  # px; tiles
_WITH_FRAME = 1.5  # size of a chart with its frame over the size of its patches
_DEGREES_PER_ROOM_DOLP = 50.0  # of the normals: 1.3 to 2.6° at 5.5 % (docs/benchmarks/gates.md)


def chart(found: Evidence[ResultsUntilWhitebalance], limits: GateLimits) -> Gate:
    """Gate on the chart: whether it was found, and the mean color error of its patches."""
    limit, color = limits.max_delta_e, found.results.color
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
    colors = color.patches
    if colors is None:
        return Gate("chart", "not measured", None, limit, "No chart was used", unit="ΔE2000")
    mean = float(np.nanmean(colors.delta_e))
    where = "" if color.place else " in the capture that shows it"
    message = f"Chart colors match within ΔE {mean:.1f}{where}"
    if colors.predicted is not None:
        message += f" ({float(np.nanmean(colors.predicted)):.1f} when cross-checked)"
    if colors.use is not None and colors.use.any():
        message += f"; {patches.left_out(colors.use)}"
    if color.light is not None and color.light.tilt > _TURNED:
        message += f"; it is turned by {np.degrees(color.light.tilt):.0f}° from the lens, which is corrected"
    if found.results.radiance.sensor.lossy:
        message += "; the pictures have 8 bits or a tone curve, which no color matrix can undo"
    remedy = "Light the chart as the object, without glare, or name its corners with --chart"
    return at_most("chart", mean, limit, message, remedy, unit="ΔE2000")


def albedo_scale(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate on the common scale of all albedos: its uncertainty; without a chart the scale is unknown."""
    sigma, limit, source = found.results.maps.albedo_sigma, limits.max_scale_doubt, found.results.color.source
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
    if sigma <= limit and not of_session:  # the pictures do not show the chart's distance
        message += (
            ", if the chart was as far from the flash as the object, which no picture shows: 10 % farther or nearer "
            "makes them 20 % too bright or too dark"
        )
    light = found.results.color.light
    if sigma > limit and light is not None and light.uneven > limit / 2:
        message += ": the chart is lit unevenly, by another lamp or through a lens that darkens the corners"
    elif sigma > limit:
        message += ": they are higher than those of white things, as if the chart had less light than the object"
    return at_most("albedo scale", sigma, limit, message, remedy, beyond="warn")


def crossed(found: Evidence[ResultsUntilStokes], limits: GateLimits) -> Iterator[Gate]:
    """Gates on the cross-polarized shot: it must be darker than S0, and not clipped where S0 is."""
    if found.results.radiance.crossed is None:
        return
    limit = limits.max_crossed_misfit
    remedy = "Set the lens's filter to the stated angle and turn the flash's filter until the highlights vanish"
    if found.results.stokes.body is None:
        message = "The brightness of the cross-polarized shot relative to the others is unknown; it is not used"
        yield Gate("crossed", "warn", None, limit, message, "Put a ColorChecker next to the object, or expose more")
        return
    seen = _compare_crossed(found.results.stokes)
    text = "{:.1f} % of the object's light is mirrored at its surface; it is removed from the albedo"
    message = worded(100 * seen.specular, text, "No light is mirrored at the object's surface")
    if seen.still_clipped > _STILL_CLIPPED and seen.clipped_px > _FEW:
        share = 100 * seen.still_clipped
        message = f"{share:.0f} % of the clipped highlights are also clipped in the cross-polarized shot"
        yield Gate("crossed", "warn", round(seen.still_clipped, 3), _STILL_CLIPPED, message, remedy)
        return
    if seen.brighter > limit:
        message = f"{100 * seen.brighter:.0f} % of the object is brighter in the cross-polarized shot than is possible"
    yield at_most("crossed", seen.brighter, limit, message, remedy, beyond="warn")


@dataclass(frozen=True)
class CrossedFigures:
    """Comparison of the cross-polarized shot with S0."""

    still_clipped: float  # share of the clipped highlights of S0 that are clipped in the crossed shot too
    clipped_px: int  # number of clipped pixels of S0
    brighter: float  # share of pixels that are brighter in the crossed shot than in S0, although S0 is all light
    specular: float  # share of the object's light that the crossed filter removes: specular reflection


def _compare_crossed(image: StokesImage) -> CrossedFigures:
    """Compare the cross-polarized shot with S0."""
    assert image.body is not None
    known = image.mask & (image.body.quality == 0)
    sound = known & ((image.quality & int(Quality.CLIPPED)) == 0)
    total, body = image.stokes[0].sum(-1), image.body.value.sum(-1)
    clipped = image.mask & ((image.quality & int(Quality.CLIPPED)) > 0)
    still_clipped = float((clipped & ~known).sum() / max(clipped.sum(), 1))
    weight = sound.astype(np.float32)
    smooth_body, smooth_total = (cv2.GaussianBlur(part * weight, (0, 0), _EDGE_PX) for part in (body, total))
    inner = erode(sound, 2)
    brighter = float((smooth_body > _BRIGHTER * smooth_total)[inner].mean()) if inner.any() else 1.0
    specular = float(np.maximum(total - body, 0)[sound].sum() / max(float(total[sound].sum()), 1e-9))
    return CrossedFigures(still_clipped, int(clipped.sum()), brighter, specular)


def ambient(found: Evidence[ResultsUntilHdr], limits: GateLimits) -> Gate:
    """Gate on the share of ambient light; it is measured only if frames without flash were taken.

    The object polarizes the room's light too. Only an ambient frame at the same angle contains the same light.
    """
    bracket, limit = found.results.radiance.bracket, limits.max_ambient
    share = bracket.ambient_share
    if not np.isfinite(share).any():
        return Gate("ambient", "not measured", None, limit, "No frame was taken without the flash")
    worst = float(np.nanmax(share))
    if not bracket.ambient_shared and (gate := _unlike_ambient(found)) is not None:
        return gate
    text = "{:.1f} % of the light does not come from the flash; the ambient frames are subtracted"
    message = worded(100 * worst, text, "All light comes from the flash")
    cost = round(_DEGREES_PER_AMBIENT * worst, 1) if bracket.ambient_shared else 0.0
    if bracket.ambient_shared and limits.max_ambient_shared < worst <= limit:
        limit = limits.max_ambient_shared
        message = f"{100 * worst:.1f} % of the light is the room's, and one ambient frame serves several angles"
        remedy = "Darken the room, or take one ambient frame per angle: subtracting them is exact"
        return Gate("ambient", "warn", round(worst, 5), limit, message, remedy, cost)
    remedy = (
        "Take the ambient frames again in a darker room, without the flash and with the settings of the shots: the "
        "noise and changes of so much light remain"
    )
    return msgspec.structs.replace(at_most("ambient", worst, limit, message, remedy), cost_deg=cost)


def _unlike_ambient(found: Evidence[ResultsUntilHdr]) -> Gate | None:
    """Gate on an ambient frame with far more or less light than those of the other angles; None if there is none.

    The room's polarization alone changes its light through the polarizer by less.
    """
    share = np.maximum(found.results.radiance.bracket.ambient_share, 1e-6)
    level = np.log(share / np.maximum(1 - share, 1e-6))  # room light over flash light
    if not np.nanmax(share) > _LEAST_AMBIENT or not np.ptp(level) > np.log(_UNLIKE):
        return None
    deviation = level - np.median(level)
    k = int(np.argmax(np.abs(deviation)))
    name, gap = found.names[k], float(abs(share[k] - np.median(share)))
    amount, cause = "less", "the lens was covered, or it was exposed less than stated"
    if deviation[k] > 0:
        amount, cause = "more", "it contains flash light"
    message = f"The ambient frame of the {name} shot has {amount} light than the others: {cause}"
    remedy = "Take that ambient frame again, without the flash and with the settings of the others"
    cost = round(min(_DEGREES_PER_UNLIKE * gap, MOST_DEG), 1)
    return Gate("ambient", "fail", round(gap, 5), _LEAST_AMBIENT, message, remedy, cost, (name,))


def flicker(found: Evidence[ResultsUntilHdr], limits: GateLimits) -> Gate:
    """Gate on lamps that flicker: the frames of a bracket differ by stripes of rows, in most shots.

    Stripes in one shot alone are something else: a hand, a blurred frame.
    """
    value, limit = found.results.radiance.bracket.flicker, limits.max_flicker
    flash = found.results.radiance.equipment.light == "flash"
    if not np.isfinite(value).any():
        return Gate("flicker", "not measured", None, limit, "Two exposures of a shot have too few lit rows in common")
    measured = value[np.isfinite(value).any(axis=1)]
    rms = float(np.quantile(np.sqrt(np.nanmean(measured**2, axis=1)), 0.5, method="lower"))  # the lower median shot's
    message = "All rows of a picture got the same light"
    if rms > limit:
        cause = "the shutter is faster than the flash, or a lamp flickers" if flash else "the lamp flickers"
        message = f"The light changes by {100 * rms:.1f} % from row to row: {cause}"
    remedy = "Use a lamp that does not flicker, a flash, or shutter times in multiples of 1/100 s (60 Hz: 1/120 s)"
    if flash:
        remedy = "Use the camera's flash synchronization time or a longer one, without high-speed synchronization"
    cost = _DEGREES_PER_FLICKER * rms
    return at_most("flicker", rms, limit, message, remedy, cost_deg=cost, beyond=grade(cost))


def room_light(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Gate:
    """Gate on the common polarization of the object's surroundings.

    A flash at the lens leaves them unpolarized, a window or a glossy lamp does not.
    """
    share, limit = surroundings_dolp(found, found.results.selfcal.gains.gain), limits.max_room_dolp
    message = worded(100 * share, "The surroundings are polarized by {:.1f} %", "The surroundings are not polarized")
    if share > limit:
        message += ": polarized light from the room, or glossy surroundings"
    remedy = "Darken the room, or take one ambient frame per angle: subtracting them is exact"
    bracket = found.results.radiance.bracket
    if np.isfinite(bracket.ambient_share).all() and not bracket.ambient_shared:
        remedy = (
            "Take the ambient frames again, with the settings of the shots and an open lens: they do not hold this "
            "light; or darken the room"
        )
    return at_most("room light", share, limit, message, remedy, cost_deg=_DEGREES_PER_ROOM_DOLP * share, beyond="warn")


def side_light(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate "lighting" on light from the sides: by its highlights, then by the albedo."""
    gate = _judge_highlights(found, limits)
    if gate.state in ("warn", "fail"):
        return gate
    slope, limit = _albedo_slope(found), limits.max_albedo_slope
    if slope is None or slope.amount <= limit:
        return gate
    times = np.exp(2 * np.sin(_LEANING) * slope.amount) - 1
    message = (
        f"Parts that lean to the {_SIDES[round(slope.azimuth / (np.pi / 4)) % len(_SIDES)]} are {100 * times:.0f} % "
        "brighter than under a flash at the lens: a lamp or window there, which bends normals and albedo (or the "
        "object is brighter there)"
    )
    cost = float(np.hypot(gate.cost_deg, _LAMP_DEG + _DEGREES_PER_ALBEDO_SLOPE * slope.amount))
    return at_most("lighting", slope.amount, limit, message, _ONE_FLASH, cost_deg=cost, beyond="warn")


def _albedo_slope(found: Evidence[ResultsUntilInfer]) -> albedo_slope.AlbedoSlope | None:
    """Dependence of the albedo on the slope, without clipped pixels; None for a small object."""
    return albedo_slope.measure(found.results.maps, found.results.cues.quality & int(Quality.CLIPPED) == 0)


def _judge_highlights(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate on the common polarization of the brightest parts that face the camera, relative to albedo.

    Under a flash at the lens their polarization points in all directions, as their normals do. Two flashes or softboxes
    at the sides polarize them in the same direction.
    """
    share, limit = _highlight_dolp(found), limits.max_highlight_dolp
    text = "The brightest parts that face the camera share a polarization of {:.1f} % or more"
    message = worded(100 * share, text, "The brightest parts that face the camera share no polarization")
    if share > limit:
        message += ": light from the sides (two flashes, softboxes, a window), or light that changed across the "
        message += "picture between shots (the flash moved, the lamp drifted); it bends normals and roughness"
    cost = float(_DEGREES_PER_ROOT_OF_HIGHLIGHT_DOLP * np.sqrt(max(np.nan_to_num(share) - _FALSE_HIGHLIGHT_DOLP, 0.0)))
    gate = at_most("lighting", share, limit, message, _ONE_FLASH, beyond=grade(cost))
    return msgspec.structs.replace(gate, cost_deg=round(cost, 1))


def _highlight_dolp(found: Evidence[ResultsUntilInfer]) -> float:
    """Common DoLP, less its 1σ, of a tenth of the surfaces that face the camera: those with the most light over albedo.

    Highlights of lamps at the sides are there, too. NaN if too little of the object faces the camera, if most of it
    leans the same way, as a cylinder, which shares a polarization under any light, or if the DoLP is above 1. The error
    is that of the median of the pixels and that of the shots' gains.
    """
    maps, cues, selfcal = found.results.maps, found.results.cues, found.results.selfcal
    inside = maps.mask & cues.mask
    inside &= cues.quality & int(Quality.CLIPPED) == 0
    towards = inside & (dot(maps.normal, rays(maps.view, *maps.mask.shape)) > _TOWARDS_CAMERA)
    if towards.sum() < max(_LEAST_TOWARDS * inside.sum(), _LEAST_FACING):
        return float("nan")
    azimuth = np.arctan2(maps.normal[towards, 1], maps.normal[towards, 0])
    polarized = 1 - maps.normal[towards, 2] ** 2  # DoLP of small tilts, but for a factor
    if np.abs((polarized * np.exp(2j * azimuth)).mean()) > _ONE_WAY * polarized.mean():
        return float("nan")
    light = cues.radiance[towards].sum(-1) / np.maximum(maps.diffuse[towards].sum(-1), _LEAST_ALBEDO)
    ratio = cues.ratio[:, towards][:, light >= np.percentile(light, 90)]  # (2, N)
    dolp = float(np.hypot(*np.median(ratio, axis=1)))
    if dolp > 1:  # the shots contradict each other
        return float("nan")
    scatter = MEDIAN_SE * np.hypot(*ratio.std(axis=1)) / np.sqrt(ratio.shape[1])
    # (2, K); a shot has half of S0, so an error σ of its gain is σ/2 of S0
    of_gains = np.linalg.pinv(mueller.analyzer(selfcal.angle))[1:] * selfcal.gains.sigma.mean(axis=1) / 2
    return max(dolp - float(np.hypot(scatter, np.linalg.norm(of_gains))), 0.0)


def contradicts_gains(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> bool:
    """Whether the surroundings are polarized with the measured gains, and hardly with equal light in all shots."""
    limit, equal = limits.max_room_dolp, np.ones_like(found.results.selfcal.gains.gain)
    measured = surroundings_dolp(found, found.results.selfcal.gains.gain)
    return measured > limit and surroundings_dolp(found, equal) < min(limit, measured / 2)


def surroundings_dolp(found: Evidence[ResultsUntilSelfcal], gain: Floats) -> float:
    """Common DoLP of the surroundings, without object and chart, for gains (K, 3) of the shots.

    The median of tiles; NaN for too few tiles.
    """
    radiance = found.results.radiance
    outside = (radiance.quality & int(Quality.CLIPPED) == 0).all(0) & ~found.results.object_.mask
    if (place := found.results.color.place) is not None:
        middle = place.corners.mean(0)
        frame = middle + _WITH_FRAME * (place.corners - middle)
        outside &= cv2.fillConvexPoly(np.zeros(outside.shape, np.uint8), frame.astype(np.int32), 1) == 0
    clear = block_means(outside, _ROOM_TILE) > 0.999
    if clear.sum() < _LEAST_ROOM_TILES:
        return float("nan")
    light = [block_means(shot, _ROOM_TILE)[clear] @ (1 / of_shot) for shot, of_shot in zip(radiance.value, gain)]
    s0, s1, s2 = np.linalg.lstsq(mueller.analyzer(found.results.selfcal.angle), np.stack(light), rcond=None)[0]
    dolp = float(np.hypot(np.median(s1 / np.maximum(s0, 1e-9)), np.median(s2 / np.maximum(s0, 1e-9))))
    return dolp if dolp <= 1 else float("nan")  # the shots contradict each other
