"""Accuracy of a rig, from a result whose object is a ball: its outline gives the true normals.

::

    ball_outline   the ball that the outline of the mask shows; an object that is no ball is refused
    ball_light     its place to a tenth of a pixel, the flash's place, the zero of the polarizer's ring
    ball_page      page and picture
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap import report
from polcap.calibrate import ball_light, ball_outline
from polcap.calibrate.ball_light import BallLight
from polcap.calibration_values import BallAccuracy
from polcap.formats.maps import result_maps
from polcap.formats.maps.maps_folder import ResultMaps
from polcap.image_values import ArrayValue, Bools, Floats
from polcap.optics import frames

_ZENITHS = (0, 15, 30, 45, 60, 75, 90)  # degrees, limits of the classes
_CLASSES = 10  # of the expected error, with equal numbers of pixels
_LEAST_RING_DEG, _RING_SIGMAS = 1.0, 2.5  # degrees, and 1σ; smaller zero errors give no warning
_FAR_FLASH = 0.12  # from the lens [distances of the object], 7°; more gives a warning
_UNLIKE = 1.5  # measured over expected error; more gives a warning
_NO_LOSS = 0.99  # contrast beyond which the DoLP shows no loss in the polarizer


class ErrorClass(msgspec.Struct, frozen=True):
    """Errors of the normals of one class of pixels, degrees."""

    least: float  # of the zenith angle or of the expected error
    most: float
    pixels: int
    mean_deg: float
    median_deg: float
    expected_deg: float  # mean


class BallShape(msgspec.Struct, frozen=True):
    """The ball in the picture."""

    radius_px: float  # on the maps
    misfit_px: float  # spread of the mask's outline about the ball's, 1σ
    outline_share: float  # of the mask's outline that lies on the ball's
    diameter_mm: float | None  # as the user states, or by the color chart; None: unknown


class FlashPlace(msgspec.Struct, frozen=True):
    """Place of the flash, to the right of the lens and above; None: not measured, as with a print on the ball."""

    distances: tuple[float, float] | None  # of the ball from the lens
    mm: tuple[float, float] | None  # None also if the ball's diameter is unknown


class PolarizerReading(msgspec.Struct, frozen=True):
    """The polarizer, as far as the light of a ball shows it."""

    zero_deg: float  # true minus stated angle of all shots
    sigma_deg: float
    applied_deg: float  # part of `zero_deg` that the run has corrected
    dolp_ratio: float  # DoLP over that of a smooth ball of index 1.5, median
    least_extinction: float | None  # a weaker polarizer would show a lower DoLP; None: the DoLP shows no loss


class BallReport(msgspec.Struct, frozen=True):
    """The measurements of `polcap validate`, as ball.json has them."""

    normals: ErrorClass
    by_zenith: tuple[ErrorClass, ...]
    by_expected: tuple[ErrorClass, ...]
    ball: BallShape
    flash: FlashPlace
    polarizer: PolarizerReading
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class MeasuredBall(ArrayValue):
    """A ball's maps, its true normals, and the measurements."""

    maps: ResultMaps
    truth: Floats  # (H, W, 3) unit, camera frame
    error: Floats  # (H, W) degrees
    inside: Bools  # (H, W) pixels of the mask that show the ball
    figures: BallReport


def measure(result: Path, diameter_mm: float | None = None) -> MeasuredBall:
    """Measure the normals of a finished result against the ball that its outline shows.

    `diameter_mm` is the ball's diameter, for lengths; None: by the color chart's distance.

    Raises ObjectError: the object is no single, whole ball. StorageError, DecodeError: the result cannot be read.
    """
    about = report.read(result)["figures"]
    maps, stokes = result_maps.read(result), result_maps.read_stokes(result).sum(axis=-1).astype(np.float64)
    seen = ball_outline.fit(maps.mask, maps.view, at_border=bool(about["object"]["mask_border"]))
    light = ball_light.fit(stokes[0], seen.ball, maps.view)
    if light.misfit > ball_light.MOST_MISFIT:  # a print: the edge is that of the mask
        light = replace(light, ball=seen.ball)
    truth, shown = light.ball.normals(maps.view, maps.mask.shape)
    inside = maps.mask & shown
    error = frames.angle_deg(maps.normal.astype(np.float64), truth)
    zenith = frames.angle_deg(truth, frames.rays(maps.view, *maps.mask.shape))
    actual, expected = error[inside], maps.confidence[inside]
    limits = np.quantile(expected, np.linspace(0, 1, _CLASSES + 1))
    found = BallReport(
        normals=_class(actual, expected, 0, 180, np.ones(len(actual), bool)),
        by_zenith=_classes(actual, expected, zenith[inside], _ZENITHS),
        by_expected=_classes(actual, expected, expected, limits),
        ball=BallShape(
            radius_px=_rounded(light.ball.radius_px(maps.view)),
            misfit_px=_rounded(seen.misfit_px),
            outline_share=_rounded(seen.share),
            diameter_mm=_rounded(diameter_mm) if diameter_mm else _by_chart_mm(maps, light, inside),
        ),
        flash=FlashPlace(None, None),
        polarizer=_polarizer(stokes, light, maps, float(about["angles"]["applied_deg"])),
    )
    if light.misfit <= ball_light.MOST_MISFIT:
        size_mm = found.ball.diameter_mm
        mm = None if size_mm is None else _pair(light.flash * size_mm / 2 / light.ball.radius, 1)
        found = msgspec.structs.replace(found, flash=FlashPlace(_pair(light.flash), mm))
    return MeasuredBall(maps, truth, error, inside, msgspec.structs.replace(found, warnings=tuple(_warnings(found))))


def accuracy(found: BallReport, capture: Mapping[str, Any], made: str) -> BallAccuracy:
    """The accuracy of the camera, lens and filter that report.json names, at a time `made` (ISO 8601)."""
    return BallAccuracy(
        made=made,
        camera=capture["camera"],
        lens=capture.get("lens", ""),
        filter=capture.get("filter", ""),
        capture=capture["name"],
        mean_deg=found.normals.mean_deg,
        median_deg=found.normals.median_deg,
        expected_deg=found.normals.expected_deg,
        pixels=found.normals.pixels,
    )


def lines(found: BallReport) -> list[str]:
    """The measurements as lines of text."""
    normals, ball, flash, ring = found.normals, found.ball, found.flash, found.polarizer
    place, unit = (flash.distances, "distances of the ball") if flash.mm is None else (flash.mm, "mm")
    where = "not measured" if place is None else f"{place[0]:+.3g} right of the lens, {place[1]:+.3g} above it, {unit}"
    size = "" if ball.diameter_mm is None else f", diameter {ball.diameter_mm:.1f} mm"
    weakest = "shows no loss" if ring.least_extinction is None else f"at least {ring.least_extinction:.0f}:1"
    zeniths = ", ".join(f"{one.mean_deg:.1f}° at {one.least:g}–{one.most:g}°" for one in found.by_zenith)
    return [
        f"normals    mean error {normals.mean_deg:.1f}°, median {normals.median_deg:.1f}°, "
        f"expected {normals.expected_deg:.1f}°; {normals.pixels} px",
        f"zenith     {zeniths}",
        f"ball       radius {ball.radius_px:.1f} px{size}, outline within {ball.misfit_px:.2f} px",
        f"flash      {where}",
        f"polarizer  zero {ring.zero_deg:+.1f}° ± {ring.sigma_deg:.1f}°, extinction {weakest}",
    ]


def _classes(error: Floats, expected: Floats, by: Floats, limits: Any) -> tuple[ErrorClass, ...]:
    """Errors of the pixels (N,) by classes of a quantity `by` (N,); empty classes are left out."""
    place = np.clip(np.searchsorted(limits, by, side="right") - 1, 0, len(limits) - 2)
    found = ((place == k, limits[k], limits[k + 1]) for k in range(len(limits) - 1))
    return tuple(_class(error, expected, low, high, chosen) for chosen, low, high in found if chosen.any())


def _class(error: Floats, expected: Floats, least: float, most: float, chosen: Bools) -> ErrorClass:
    """Errors of the `chosen` pixels (N,), a class with the limits `least` and `most`."""
    errors = error[chosen].mean(), np.median(error[chosen]), expected[chosen].mean()
    return ErrorClass(_rounded(least), _rounded(most), int(chosen.sum()), *map(_rounded, errors))


def _by_chart_mm(maps: ResultMaps, light: BallLight, inside: Bools) -> float | None:
    """Diameter of the ball [mm] by the depth map, with the scale of the color chart; None without a chart."""
    if not maps.metric:
        return None
    point, _ = light.ball.points(frames.rays(maps.view, *inside.shape))
    distance = float(np.nanmedian(maps.depth[inside] / -point[..., 2][inside]))
    return _rounded(2000 * distance * light.ball.radius)  # mm, twice the radius


def _polarizer(stokes: Floats, light: BallLight, maps: ResultMaps, applied_deg: float) -> PolarizerReading:
    """Error of the ring's zero, and the contrast of the polarizer, from the AoLP of the ball."""
    ring = ball_light.read_ring(stokes, light.ball, maps.view, maps.mask)
    contrast = ring.contrast
    return PolarizerReading(
        zero_deg=_rounded(applied_deg + np.degrees(ring.offset)),
        sigma_deg=_rounded(np.degrees(ring.sigma)),
        applied_deg=_rounded(applied_deg),
        dolp_ratio=_rounded(contrast),
        least_extinction=None if contrast >= _NO_LOSS else _rounded((1 + contrast) / (1 - contrast)),
    )


def _warnings(found: BallReport) -> Iterator[str]:
    """Faults of the rig, each with a remedy."""
    normals, ring, flash = found.normals, found.polarizer, found.flash.distances
    if flash is None:
        text = "the ball has prints or mirrors lamps, so its edge is only as good as the mask"
        yield f"{text}; use a clean ball of one color in a dark room"
    elif np.hypot(*flash) > _FAR_FLASH:
        slant = np.degrees(np.arctan(np.hypot(*flash)))
        yield f"the flash is {slant:.0f}° off the lens, seen from the ball; move it closer to the lens"
    if abs(ring.zero_deg) > max(_LEAST_RING_DEG, _RING_SIGMAS * ring.sigma_deg):
        done = f", of which {ring.applied_deg:+.1f}° were corrected" if ring.applied_deg else ""
        text = f"the polarizer's ring is off by {ring.zero_deg:+.1f}° ± {ring.sigma_deg:.1f}°{done}"
        yield f"{text}; set its zero to the horizontal, or state the true angles"
    if normals.mean_deg > _UNLIKE * normals.expected_deg:
        text = f"the normals err by {normals.mean_deg:.1f}°, expected are {normals.expected_deg:.1f}°"
        yield f"{text}; read the gates of report.html, and see that the ball's surface is clean and not metallic"


def _pair(values: Floats, digits: int = 4) -> tuple[float, float]:
    """A place right of the lens and above it (2,), rounded for JSON."""
    right, up = (_rounded(value, digits) for value in values)
    return right, up


def _rounded(value: Any, digits: int = 3) -> float:
    return round(float(value), digits)
