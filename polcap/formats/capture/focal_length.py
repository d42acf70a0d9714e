"""Finds the focal length in pixels: stated by the user, from EXIF, or assumed; with its source and possible range."""

import math
import tomllib
from functools import cache
from typing import NamedTuple

from polcap.calibration_values import LensGeometry
from polcap.capture_values import Exif
from polcap.formats import shipped_data

FULL_FRAME_MM = (36.0, 24.0)
_FULL_DIAGONAL_MM = math.hypot(*FULL_FRAME_MM)
_CONTRADICTION = 0.1  # ln of the ratio of two statements; focus breathing and rounding stay below
_KNOWN = 0.0, 0.0
_ASSUMED = -math.log(2.0), math.log(2.0)  # lenses of 25 to 100 mm equivalent; sensors from full frame to half its width
NORMAL_MM = 50.0  # full-frame equivalent, assumed where nothing is known


class FocalLength(NamedTuple):
    """Focal length in pixels, the range (least, greatest) in which it may lie, and a sentence on its source."""

    px: float  # visible RAW pixels
    doubt: tuple[float, float]  # ln of the least and the greatest possible value over px; 0, 0: known
    note: str

    @property
    def known(self) -> bool:
        return self.doubt == _KNOWN


class _Source(NamedTuple):
    """A statement on the width of the sensor, with the focal length that follows from it."""

    px: float  # visible RAW pixels
    text: str  # a sentence without the focal length, for a note
    dissent: str  # the same as a contradiction to another source
    trust: int  # between sources that contradict each other: the greater decides
    stated: bool = False  # by the user

    def agrees(self, other: "_Source") -> bool:
        return abs(math.log(self.px / other.px)) <= _CONTRADICTION


def find(exif: Exif, stated_mm: float | None, stated_width_mm: float | None) -> FocalLength:
    """Focal length in visible RAW pixels from EXIF, or from the user's statement, which overrides EXIF.

    If sources contradict each other by more than 10 %, the range of doubt includes each of them.
    """
    focal, diagonal = stated_mm or exif.focal_length_mm, math.hypot(exif.width or 0, exif.height or 0)
    sources = _sources(exif, stated_mm, stated_width_mm)
    if not sources and focal:
        note = f"{focal:g} mm, sensor size unknown: full frame assumed; state sensor_width_mm in capture.toml"
        found = FocalLength(focal / FULL_FRAME_MM[0] * (exif.width or 0), _ASSUMED, note)
    elif not sources:
        note = "unknown: 50 mm full-frame equivalent assumed; state focal_length_mm in capture.toml"
        found = FocalLength(NORMAL_MM / _FULL_DIAGONAL_MM * diagonal, _ASSUMED, note)
    else:
        found = _most_plausible(sources)
    gap = math.log(exif.focal_length_mm / stated_mm) if stated_mm and exif.focal_length_mm else 0.0
    if abs(gap) <= _CONTRADICTION:
        return found
    note = f"{found.note}, but EXIF states {exif.focal_length_mm:g} mm: correct one of the two"
    return FocalLength(found.px, (min(gap, 0.0) + found.doubt[0], max(gap, 0.0) + found.doubt[1]), note)


def _sources(exif: Exif, stated_mm: float | None, stated_width_mm: float | None) -> list[_Source]:
    """All statements from which the focal length follows, the most precise first."""
    width, focal = exif.width or 0, stated_mm or exif.focal_length_mm
    widths = (  # mm, source, words of a contradiction, trust
        (stated_width_mm, "capture.toml", "capture.toml states", 3),
        (exif.pixel_pitch_um and exif.pixel_pitch_um * width / 1e3, "EXIF", "FocalPlaneResolution of EXIF states", 0),
        (sensor_widths().get(exif.model), "table of cameras", "the table of cameras has", 1),
    )
    found = [
        _Source(
            focal / sensor * width,
            f"{focal:g} mm on a sensor {sensor:.1f} mm wide ({'capture.toml' if stated_mm else source})",
            f"{verb} {sensor:.1f} mm",
            trust,
            stated=source == "capture.toml",
        )
        for sensor, source, verb, trust in widths
        if focal and sensor
    ]
    if equivalent := exif.focal_length_35mm:  # by its definition of equal diagonals, in whole millimetres
        lens_ratio = stated_mm / exif.focal_length_mm if stated_mm and exif.focal_length_mm else 1.0
        px = lens_ratio * equivalent / _FULL_DIAGONAL_MM * math.hypot(width, exif.height or 0)
        text = f"{lens_ratio * equivalent:g} mm full-frame equivalent (EXIF, to about 2 %)"
        width_mm = f", a sensor {focal / px * width:.1f} mm wide" if focal else ""
        # a camera states the equivalent of the picture; the table does not know its crop mode
        found.append(_Source(px, text, f"EXIF states {equivalent:g} mm full-frame equivalent{width_mm}", 2))
    return found


def _most_plausible(sources: list[_Source]) -> FocalLength:
    """Focal length by the user's statement, else by the most precise of the sources that agree with most others."""
    best = max(sources, key=lambda one: (one.stated, sum(one.agrees(other) for other in sources), one.trust))
    chosen = next(one for one in sources if one.agrees(best))  # `sources` begin with the most precise
    others = [one for one in sources if not one.agrees(chosen)]
    if not others:
        return FocalLength(chosen.px, _KNOWN, chosen.text)
    gaps = [math.log(one.px / chosen.px) for one in others]
    confirmed = chosen.stated and any(one.agrees(chosen) for one in sources if one is not chosen)
    remedy = "correct one of the two" if chosen.stated else "a crop mode? State sensor_width_mm in capture.toml"
    note = f"{chosen.text}, but {' and '.join(one.dissent for one in others)}" + f": {remedy}" * (not confirmed)
    return FocalLength(chosen.px, _KNOWN if confirmed else (min(*gaps, 0.0), max(*gaps, 0.0)), note)


def calibrated(geometry: LensGeometry) -> FocalLength:
    """Focal length in pixels as measured by `polcap calibrate`."""
    note = f"{geometry.focal_px:.0f} px ± {geometry.focal_sigma_px:.1f} (calibrated)"
    return FocalLength(geometry.focal_px, _KNOWN, note)


@cache
def sensor_widths() -> dict[str, float]:
    """Sensor width [mm] by EXIF camera model, from the table calib/cameras/sensors.toml."""
    table = tomllib.loads(shipped_data.data_path("cameras/sensors.toml").read_text(encoding="utf-8"))
    return {model: float(width) for model, width in table["width_mm"].items()}
