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
from polcap.formats import atomic, own_folders, text_file

_HEAD = "# polcap validate: errors of the normals of a ball, in degrees. Delete this file to forget them.\n"
_MOST_DEG = 180.0


def write(found: BallAccuracy) -> Path:
    """Write a measurement as a dated TOML file into the user's folder and return the file's path."""
    parts = [found.made[:19].replace(":", ""), found.camera, found.lens, found.filter]
    path = own_folders.ball_accuracies() / (atomic.safe_name(" ".join(part for part in parts if part)) + ".toml")
    atomic.write(path, _HEAD + text_file.to_toml(msgspec.to_builtins(found)))
    return path


def choose(exif: Exif, lens_filter: str | None) -> BallAccuracy | None:
    """The newest stored measurement of this camera, lens and polarizing filter; None if there is none.

    Raises CaptureError: a file in the folder is not such a measurement.
    """
    place = own_folders.ball_accuracies()
    files = sorted(place.glob("[!.]*.toml")) if place.is_dir() else []
    wanted = exif.camera, exif.lens, lens_filter or ""
    fitting = [found for found in map(_read, files) if _rig(found.camera, found.lens, found.filter) == _rig(*wanted)]
    return max(fitting, key=lambda found: found.made) if exif.camera and fitting else None


def _rig(*names: str) -> list[str]:
    return [normalize("NFC", name) for name in names]


def _read(path: Path) -> BallAccuracy:
    """Read a stored measurement. Raises CaptureError: it is damaged, or impossible."""
    try:
        found = msgspec.convert(text_file.read_toml(path), BallAccuracy)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); repair or remove it") from None
    except ValueError as error:
        raise CaptureError(f"{path}: is no measurement of a ball ({error}); validate again, or remove it") from None
    if not all(0 <= error <= _MOST_DEG for error in (found.mean_deg, found.median_deg, found.expected_deg)):
        raise CaptureError(f"{path}: its errors are impossible; validate again, or remove it")
    return found
