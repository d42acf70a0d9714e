"""In: a folder of calibration photographs. Out: each with its EXIF, decoded when asked for, and grouped by setting."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polcap.errors import CaptureError
from polcap.formats.capture import layouts
from polcap.formats.raw import libraw as raw
from polcap.formats.raw import probe
from polcap.images import Exif, Floats, SensorImage
from polcap.optics import sensor

CLIP = 0.95  # of the white level: nothing is measured above
_ANGLE = re.compile(r"(\d{1,3}(?:\.\d+)?)")


@dataclass(frozen=True)
class Photograph:
    """One file."""

    path: Path
    exif: Exif
    digest: str

    def image(self) -> SensorImage:
        """Decoded. Raises DecodeError."""
        return raw.read(self.path, self.digest)

    @property
    def setting(self) -> tuple[float, float, float]:
        """ISO, exposure time [s], f-number; 0 where the file does not say."""
        return self.exif.iso or 0.0, self.exif.exposure_time or 0.0, self.exif.f_number or 0.0


def listed(folder: Path) -> list[Photograph]:
    """The RAW photographs of a folder in the order of their names; of finished pictures there is nothing to measure.

    Raises
    ------
    CaptureError
        There is none, or the folder cannot be listed.
    """
    files = [path for path in layouts.children(folder) if path.is_file()]
    found = []
    for path in sorted(files, key=lambda one: layouts.natural(one.name)):
        known = probe.read(path)
        if known.kind == "raw":
            found.append(Photograph(path, known.exif, known.digest))
    if not found:
        raise CaptureError(f"{folder}: holds no RAW photograph; take some, or remove the folder")
    return found


def inside(folder: Path, prefix: str) -> list[tuple[float, Path]]:
    """Sub-folders such as pol022.5, with the angle that their names state [degrees], by angle."""
    found = [(angle_of(path.name, prefix), path) for path in layouts.children(folder) if path.is_dir()]
    return sorted((angle, path) for angle, path in found if angle is not None)


def angle_of(name: str, prefix: str) -> float | None:
    """Degrees in `pol045` or `axis22.5`; None where the name is no such."""
    match = _ANGLE.fullmatch(name.removeprefix(prefix)) if name.startswith(prefix) else None
    return None if match is None else float(match.group(1))


def by_setting(photographs: Iterable[Photograph]) -> dict[tuple[float, float, float], list[Photograph]]:
    """Photographs of equal ISO, exposure time and f-number, darkest first."""
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
