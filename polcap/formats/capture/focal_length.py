"""Finds the focal length in pixels: stated by the user, from EXIF, or assumed; with its source and possible range."""

import math
import tomllib
from dataclasses import replace
from functools import cache
from typing import NamedTuple

from polcap.calibration_values import LensGeometry
from polcap.formats import shipped_data
from polcap.images import Exif

FULL_FRAME_MM = (36.0, 24.0)
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
        return self.doubt == (0.0, 0.0)


def find(exif: Exif, stated_mm: float | None, stated_width_mm: float | None) -> FocalLength:
    """Focal length in visible RAW pixels from EXIF, or from the user's statement, which overrides EXIF."""
    width, height = exif.width or 0, exif.height or 0
    diagonal = math.hypot(width, height)
    equivalent = exif.focal_length_35mm  # by its definition of equal diagonals, in whole millimetres
    focal = stated_mm or exif.focal_length_mm
    gap = math.log(exif.focal_length_mm / stated_mm) if stated_mm and exif.focal_length_mm else 0.0
    if abs(gap) > _CONTRADICTION:
        found = find(replace(exif, focal_length_mm=None), stated_mm, stated_width_mm)
        note = f"{found.note}, but EXIF states {exif.focal_length_mm:g} mm: correct one of the two"
        return FocalLength(found.px, (min(gap, found.doubt[0]), max(gap, found.doubt[1])), note)
    sensor = stated_width_mm or (exif.pixel_pitch_um and exif.pixel_pitch_um * width / 1e3)
    sensor = sensor or sensor_widths().get(exif.model)
    if focal and sensor:
        source = "capture.toml" if stated_mm or stated_width_mm else "EXIF"
        return FocalLength(focal / sensor * width, _KNOWN, f"{focal:g} mm on a sensor {sensor:.1f} mm wide ({source})")
    if equivalent and not stated_mm:
        px = equivalent / math.hypot(*FULL_FRAME_MM) * diagonal
        return FocalLength(px, _KNOWN, f"{equivalent:g} mm full-frame equivalent (EXIF, to about 2 %)")
    if focal:
        return FocalLength(
            focal / FULL_FRAME_MM[0] * width,
            _ASSUMED,
            f"{focal:g} mm, sensor size unknown: full frame assumed; state sensor_width_mm in capture.toml",
        )
    px = NORMAL_MM / math.hypot(*FULL_FRAME_MM) * diagonal
    note = "unknown: 50 mm full-frame equivalent assumed; state focal_length_mm in capture.toml"
    return FocalLength(px, _ASSUMED, note)


def calibrated(geometry: LensGeometry) -> FocalLength:
    """Focal length in pixels as measured by `polcap calibrate`."""
    note = f"{geometry.focal_px:.0f} px ± {geometry.focal_sigma_px:.1f} (calibrated)"
    return FocalLength(geometry.focal_px, _KNOWN, note)


@cache
def sensor_widths() -> dict[str, float]:
    """Sensor width [mm] by EXIF camera model, from the table calib/cameras/sensors.toml."""
    table = tomllib.loads(shipped_data.data_path("cameras/sensors.toml").read_text(encoding="utf-8"))
    return {model: float(width) for model, width in table["width_mm"].items()}
