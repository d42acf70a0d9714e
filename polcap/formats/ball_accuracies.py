"""Writes and chooses the measurements of `polcap validate`: errors of the normals of a ball (TOML).

The dated files are in the folder balls/ of the user's calibrations. A capture quotes the newest of its camera, lens and
filter.
"""

from pathlib import Path
from unicodedata import normalize

import msgspec

from polcap.calibration_values import BallAccuracy
from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import atomic, calibrations, own_folders, text_file

_HEAD = "# polcap validate: errors of the normals of a ball, in degrees. Delete this file to forget them.\n"
_MOST_DEG = 180.0  # between two normals


def write(found: BallAccuracy) -> Path:
    """Write a measurement as a dated TOML file into the user's folder and return the file's path."""
    path = calibrations.dated_file(own_folders.ball_accuracies(), found)
    atomic.write(path, _HEAD + text_file.to_toml(msgspec.to_builtins(found)))
    return path


def choose(exif: Exif, lens_filter: str | None) -> BallAccuracy | None:
    """The newest stored measurement of this camera, lens and polarizing filter, or None. Raises CaptureError."""
    files = own_folders.toml_files(own_folders.ball_accuracies())
    rig = exif.camera, exif.lens, lens_filter or ""
    fitting = [found for found in map(_read, files) if _nfc(found.camera, found.lens, found.filter) == _nfc(*rig)]
    return max(fitting, key=lambda found: found.made) if exif.camera and fitting else None


def _nfc(*names: str) -> list[str]:
    """Names in one Unicode form, for comparison."""
    return [normalize("NFC", name) for name in names]


def _read(path: Path) -> BallAccuracy:
    """Read a stored measurement. Raises CaptureError: it is damaged, or impossible."""
    found = calibrations.read_measurement(path, BallAccuracy, "is no measurement of a ball", "validate again")
    if not all(0 <= error <= _MOST_DEG for error in (found.mean_deg, found.median_deg, found.expected_deg)):
        raise CaptureError(f"{path}: its errors are impossible; validate again, or remove it")
    return found
