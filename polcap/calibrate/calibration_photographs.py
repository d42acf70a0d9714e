"""Reads calibration photographs: RAW files of a folder with EXIF, grouped by exposure setting or angle."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats.capture import folder_names, photograph_files
from polcap.formats.raw import libraw as raw
from polcap.image_values import Floats, SensorImage
from polcap.optics import sensor

CLIP = 0.95  # of the saturated count; pixels above are not used
_MOST_CLIPPED = 0.01  # share of a picture's middle
_ANGLE = re.compile(r"(\d{1,3}(?:\.\d+)?)")


@dataclass(frozen=True)
class Photograph:
    """One RAW file of a calibration with its EXIF."""

    path: Path
    exif: Exif
    digest: str

    def image(self) -> SensorImage:
        """Decode the photograph. Raises DecodeError."""
        return raw.read(self.path, self.digest)

    @property
    def setting(self) -> tuple[float, float, float]:
        """Exposure setting of the photograph: ISO, exposure time [s], f-number; 0 if the file does not state it."""
        return self.exif.iso or 0.0, self.exif.exposure_time or 0.0, self.exif.f_number or 0.0


def photographs_in(folder: Path) -> list[Photograph]:
    """The RAW photographs of a folder in the order of their names.

    Raises CaptureError if there is none, or the folder cannot be listed.
    """
    files, _ = photograph_files.read_all(folder)
    raws = {path: file for path, file in files.items() if file.kind == "raw"}
    ordered = sorted(raws, key=lambda path: folder_names.natural(path.name))
    photographs = [Photograph(path, raws[path].exif, raws[path].digest) for path in ordered]
    if not photographs:
        raise CaptureError(f"{folder}: holds no RAW photograph; take some, or remove the folder")
    return photographs


def angle_folders(folder: Path, prefix: str) -> list[tuple[float, Path]]:
    """Sub-folders named by an angle, such as pol022.5, in order: angle [degrees] and path."""
    folders = [(angle_of(path.name, prefix), path) for path in folder_names.children(folder) if path.is_dir()]
    return sorted((angle, path) for angle, path in folders if angle is not None)


def angle_of(name: str, prefix: str) -> float | None:
    """Angle [degrees] in a folder name such as `pol045` or `axis22.5`; None for another name."""
    match = _ANGLE.fullmatch(name.removeprefix(prefix)) if name.startswith(prefix) else None
    return None if match is None else float(match.group(1))


def by_setting(photographs: Iterable[Photograph]) -> dict[tuple[float, float, float], list[Photograph]]:
    """Group photographs of equal ISO, exposure time and f-number; groups are sorted from dark to bright."""
    groups: dict[tuple[float, float, float], list[Photograph]] = {}
    for one in photographs:
        groups.setdefault(one.setting, []).append(one)
    return dict(sorted(groups.items()))


def center(image: SensorImage) -> tuple[Floats, float]:
    """Mean signal (C,) of the picture's middle ninth, and the share of its pixels that are clipped."""
    value, usable = sensor.signal(image), sensor.usable(image, CLIP)
    h, w = value.shape[:2]
    part = (slice(h // 3, h - h // 3), slice(w // 3, w - w // 3))
    return value[part].mean(axis=(0, 1), dtype=np.float64), float(np.mean(~usable[part]))


def exposed_center(one: Photograph) -> Floats:
    """Mean signal (C,) of the picture's middle ninth. Raises CaptureError if it is over-exposed."""
    mean, clipped = center(one.image())
    if clipped > _MOST_CLIPPED:
        raise CaptureError(f"{one.path}: {100 * clipped:.0f} % of its middle is over-exposed; take less light")
    return mean
