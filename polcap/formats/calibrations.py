"""Reads, writes and chooses the user's calibrations of camera, lens and filter (TOML).

`polcap calibrate` writes dated files into the user's folder, $POLCAP_CALIB or the system's folder for settings; a
capture uses the newest that fits it.
"""

from dataclasses import replace
from pathlib import Path
from typing import TypeVar
from unicodedata import normalize

import msgspec
import numpy as np

from polcap.calibration_values import BallAccuracy, Calibration, LensGeometry
from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import atomic, own_folders, text_file
from polcap.image_values import Distortion
from polcap.optics import distortion

_FULL_TURN = 360.0  # degrees
_MAX_SIDE = 1_000_000  # px of a picture
_MAX_DISTORTION = 1000.0  # of k1 and k2; only a picture that folds over itself has more
_LEAST_LIGHT = 0.02  # in a corner of the lens, relative to the middle
_SAME_SETTING = 0.05  # relative change of f-number or focal length
_CHANNELS = (1, 3)
_Measurement = TypeVar("_Measurement", Calibration, BallAccuracy)
_HEAD = """\
# polcap calibration. Signals: 1 is the sensor's white. Each sigma is 1σ. Angles from image x towards image up.
# noise: variance of a pixel of the merged picture (half size) = slope * signal + floor.
# geometry: a point at x appears at x (1 + k1 r^2 + k2 r^4), x and r from the principal point in focal lengths.
# falloff: light = 1 + a r^2 + b r^4 + c r^6, r = 1 in the corners. polarizer: axis = sense * stated + zero_deg.
"""


def write(place: Path, found: Calibration) -> Path:
    """Write a calibration as a dated TOML file into the folder `place` and return the file's path."""
    path = dated_file(place, found)
    atomic.write(path, text(found))
    return path


def dated_file(place: Path, found: Calibration | BallAccuracy) -> Path:
    """Path of a TOML file in the folder `place`, named by time, camera, lens and filter of a measurement."""
    parts = [found.made[:19].replace(":", ""), found.camera, found.lens, found.filter]
    return place / (atomic.safe_name(" ".join(part for part in parts if part)) + ".toml")


def text(found: Calibration) -> str:
    """TOML text of a calibration, as `write` puts it into the file."""
    return _HEAD + text_file.to_toml(msgspec.to_builtins(found))


def read(path: Path) -> Calibration:
    """Read a calibration file that `write` wrote. Raises CaptureError."""
    found = read_measurement(path, Calibration, "not a polcap calibration", "calibrate again")
    if wrong := _impossible_parts(found):
        raise CaptureError(f"{path}: its {', '.join(wrong)} is impossible; calibrate again, or remove the file")
    return found


def read_measurement(path: Path, kind: type[_Measurement], fault: str, remedy: str) -> _Measurement:
    """Read a TOML file of this kind. Raises CaptureError, with `fault` and `remedy` where it is of another kind."""
    try:
        return msgspec.convert(text_file.read_toml(path), kind)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); repair or remove it") from None
    except ValueError as error:
        raise CaptureError(f"{path}: {fault} ({error}); {remedy}, or remove it") from None


def choose(exif: Exif, lens_filter: str | None, focal_length_mm: float | None) -> tuple[Calibration | None, list[str]]:
    """The newest stored calibration that fits this camera, lens and polarizing filter, and notes on its use.

    Parts that were measured at another aperture or focal length are left out. Without `lens_filter`, the filter is
    the only one in the calibrations of this camera and lens; with several, none is used.

    Raises CaptureError: a file in the folder is not a calibration.
    """
    fitting = []
    for path in own_folders.toml_files(own_folders.calibrations()):
        found = read(path)
        if exif.camera and found.camera == exif.camera and (not found.lens or not exif.lens or found.lens == exif.lens):
            fitting.append((found, path))
    if not fitting:
        return None, []
    names = sorted({found.filter for found, _ in fitting})
    if lens_filter is None and len(names) > 1:
        listed = ", ".join(name or "(none)" for name in names)
        return None, [f"calibration: several filters are known ({listed}); state filter in capture.toml to use one"]
    wanted = names[0] if lens_filter is None else lens_filter
    of_filter = [pair for pair in fitting if normalize("NFC", pair[0].filter) == normalize("NFC", wanted)]
    if not of_filter:
        return None, [f'calibration: none of filter "{wanted}" for this camera and lens']
    found, path = max(of_filter, key=lambda pair: pair[0].made)
    notes = [f"calibration {path.name}: {', '.join(_parts(found))}"]
    focal = focal_length_mm or exif.focal_length_mm
    light, lens = found.falloff, found.geometry
    if light is not None and not _alike((light.f_number, exif.f_number), (light.focal_length_mm, focal)):
        found = replace(found, falloff=None)
        notes.append("calibration: the falloff was measured at another aperture or focal length and is not used")
    size = exif.width, exif.height
    if lens is not None and not (lens.size_px == size and _alike((lens.focal_length_mm, focal))):
        found = replace(found, geometry=None)
        notes.append(
            "calibration: the lens was measured at another focal length or picture size; its geometry is not used"
        )
    return found, notes


def _alike(*pairs: tuple[float | None, float | None]) -> bool:
    """Whether the lens settings (aperture or focal length) of each pair are equal; an unknown value equals any."""
    return all(not one or not other or abs(one / other - 1) < _SAME_SETTING for one, other in pairs)


def _parts(found: Calibration) -> list[str]:
    """The measured parts of a calibration in words, such as the lens with its focal length."""
    parts = ["noise at ISO " + ", ".join(f"{line.iso:g}" for line in found.noise)] if found.noise else []
    if found.falloff is not None:
        parts.append("falloff of the lens")
    if (lens := found.geometry) is not None:
        parts.append(f"lens {lens.focal_px:.0f} ± {lens.focal_sigma_px:.1f} px, k1 {lens.k1:+.4f}, k2 {lens.k2:+.4f}")
    if (ring := found.polarizer) is not None:
        parts.append(f"polarizer {ring.zero_deg:+.2f}° ± {ring.zero_sigma_deg:.2f}°{', mirrored' * (ring.sense < 0)}")
    if found.flash is not None:
        parts.append(f"flash ± {100 * found.flash.spread:.2f} %")
    return parts


def _impossible_parts(found: Calibration) -> list[str]:
    """Names of the parts of a calibration with physically impossible figures."""
    ring, light, lens, flash = found.polarizer, found.falloff, found.geometry, found.flash
    possible = {
        "noise": all(
            line.iso > 0 and len(line.slope) == len(line.floor) in _CHANNELS
            and 0 < min(line.slope) <= max(line.slope) < 1 and 0 <= min(line.floor) <= max(line.floor) < 1
            for line in found.noise
        ),
        "falloff": not light or (len(light.coefficient) in _CHANNELS and all(map(_leaves_light, light.coefficient))),
        "geometry": not lens or _possible_lens(lens),
        "polarizer": not ring or (
            len(ring.extinction) in _CHANNELS and min(ring.extinction) > 1 and ring.sense in (-1, 1)
            and abs(ring.zero_deg) <= _FULL_TURN and 0 <= ring.zero_sigma_deg <= _FULL_TURN
        ),
        "flash": not flash or 0 < flash.spread < 1,
    }  # fmt: skip
    return [name for name, holds in possible.items() if not holds]


def _possible_lens(lens: LensGeometry) -> bool:
    """Whether a lens calibration is plausible: principal point inside the picture, distortion without folds."""
    inside = all(0 < c < side <= _MAX_SIDE for c, side in zip(lens.principal_px, lens.size_px))
    small = lens.focal_px >= 1 and max(abs(lens.k1), abs(lens.k2)) <= _MAX_DISTORTION
    measured = Distortion(lens.focal_px, lens.principal_px, lens.k1, lens.k2)
    return inside and small and not distortion.folds(measured, *lens.size_px)


def _leaves_light(coefficients: tuple[float, float, float]) -> bool:
    """Whether the lens falloff 1 + a r² + b r⁴ + c r⁶ is above `_LEAST_LIGHT` in the whole picture (17 radii)."""
    return bool(np.min(np.polyval([*reversed(coefficients), 1], np.linspace(0, 1, 17))) > _LEAST_LIGHT)
