"""Reads camera settings from the EXIF tags of RAW files of every maker, and of finished pictures.

It runs in the child process. The number of pixels comes from the decoder, not from the tags.
"""

import io
import logging
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from functools import cache
from itertools import islice
from typing import Any

from polcap.capture_values import Exif
from polcap.errors import SettingError

_D65_FIRST = (21, 20, 22, 23, 1, 4, 9, 10, 11, 12, 13, 14, 15)  # EXIF LightSource, the daylights
UPRIGHT_DEG = {1: 0, 8: 90, 3: 180, 6: 270}  # by EXIF Orientation; mirrored pictures are used as stored
_UNIT_MM = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit; 1 "none" is inch in practice
_SENSOR_MM = (2.0, 70.0)  # plausible widths; others come from a wrong unit
_RESIZED = 1.12  # ratio of widths above which a picture was resized, not cropped; mRAW has 4/3
_TINY_TIFF = b"II*\0\x08\0\0\0\x01\0\x0f\x01\x02\0\x04\0\0\0abc\0\0\0\0\0"  # a TIFF with the make abc
_TEXT_LENGTH = 100  # of a name; the rest is cut
_HEADER = re.compile(rb"II\*\0|MM\0\*")  # of a TIFF
_SEARCH_BYTES = 1 << 20  # from the beginning of a file
_ISO = (  # the second is that of Panasonic's RW2
    "ISOSpeedRatings", "Tag 0x0017", "RecommendedExposureIndex", "StandardOutputSensitivity", "ISOSpeed",
)  # fmt: skip

logging.getLogger("exifread").setLevel(logging.CRITICAL)  # its warnings are about tags that are not used here


class _Tags:
    """EXIF tags of a file by name, from its EXIF directory or else from the first directory."""

    def __init__(self, data: bytes) -> None:
        import exifread

        _check_reader()
        self._found: dict[str, Any] = {}
        for directory, part in _parts(data):
            try:
                found = exifread.process_file(io.BytesIO(part), details=False, extract_thumbnail=False)
            except Exception:  # exifread documents no errors of its own for a damaged tag: taken as absent
                continue
            self._found |= {name.replace("Image ", directory, 1): tag.values for name, tag in found.items()}

    def numbers(self, name: str) -> list[float]:
        """Finite numbers of a tag; empty if there are none."""
        for directory in ("EXIF ", "Image "):
            values = self._found.get(directory + name, ())
            try:
                numbers = [float(value) for value in (values if isinstance(values, list | tuple) else [values])]
            except (ValueError, TypeError, ZeroDivisionError):  # "unknown" is written 0/0
                continue
            if numbers and all(map(math.isfinite, numbers)):
                return numbers
        return []

    def number(self, name: str) -> float | None:  # the first one
        return next(iter(self.numbers(name)), None)

    def text(self, name: str) -> str:
        """Printable text of a tag; "" without one."""
        for directory in ("EXIF ", "Image "):
            # printable only: a name goes to the terminal, the report and other files
            text = "".join(c for c in str(self._found.get(directory + name, "")) if c.isprintable()).strip()
            if text:
                return text[:_TEXT_LENGTH]
        return ""


@cache
def _check_reader() -> None:
    """Raise a SettingError if the installed exifread cannot read a valid tag, so that no photograph is blamed."""
    import exifread

    try:
        found = str(exifread.process_file(io.BytesIO(_TINY_TIFF), details=False, extract_thumbnail=False)["Image Make"])
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
    if found != "abc":
        version = getattr(exifread, "__version__", "of unknown version")
        raise SettingError(
            f"EXIF cannot be read: exifread {version} does not read a sound tag ({found}); "
            "pip install --force-reinstall 'exifread>=3.5'"
        )


def _parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    """The parts of a photograph that hold EXIF: name of the directory, and bytes that exifread can parse."""
    starts = (match.start() for match in _HEADER.finditer(data[:_SEARCH_BYTES]))
    if data[4:12] == b"ftypcrx ":  # Canon CR3: the camera's and the shot's directories are TIFFs of their own
        yield from ((name, data[at:]) for name, at in zip(("Image ", "EXIF "), starts))
    elif data[:4] in (b"FUJI", b"\0MRM"):  # Fujifilm RAF, Minolta MRW: a TIFF inside
        yield from (("Image ", data[at:]) for at in islice(starts, 1))
    else:
        yield "Image ", data


def tags(data: bytes) -> Exif:
    """Camera settings from EXIF tags, with the image width that the tags state; empty values without EXIF."""
    found = _Tags(data)
    width = found.number("Tag 0xC791") or found.number("ExifImageWidth")
    time, speed = found.number("ExposureTime"), found.number("ShutterSpeedValue")
    if not time and speed is not None and abs(speed) < 30:
        time = 2.0**-speed  # APEX
    resolution = found.number("FocalPlaneXResolution")
    unit_mm = _UNIT_MM.get(int(found.number("FocalPlaneResolutionUnit") or 2))
    flash = found.number("Flash")
    return Exif(
        make=found.text("Make"),
        model=found.text("Model"),
        lens=found.text("LensModel"),
        serial=found.text("BodySerialNumber") or found.text("Tag 0xC62F"),  # the second is that of DNG
        upright_deg=UPRIGHT_DEG.get(int(found.number("Orientation") or 1), 0),
        exposure_time=time or None,
        f_number=found.number("FNumber") or None,
        # 65535 means a value above 16 bits, which is in another tag; of a pair (0, 200) the second counts
        iso=next((iso for name in _ISO for iso in found.numbers(name) if 0 < iso != 65535), None),
        focal_length_mm=found.number("FocalLength") or None,
        focal_length_35mm=found.number("FocalLengthIn35mmFilm") or None,
        pixel_pitch_um=1e3 * unit_mm / resolution if resolution and unit_mm else None,
        taken=_taken(found),
        flash_fired=None if flash is None else bool(int(flash) & 1),
        color_matrix=_color_matrix(found),
        width=int(width) if width else None,
    )


def sized(stated: Exif, width: int, height: int) -> Exif:
    """Camera settings with the size replaced by the decoder's (visible RAW pixels), and the pixel pitch."""
    pitch = stated.pixel_pitch_um
    if pitch is not None:
        ratio = (stated.width or width) / width
        if max(ratio, 1 / ratio) > _RESIZED:  # the tag states the pitch before the picture was resized
            pitch *= ratio
        if not _SENSOR_MM[0] < pitch * width / 1e3 < _SENSOR_MM[1]:
            pitch = None
    return replace(stated, width=width, height=height, pixel_pitch_um=pitch)


def _taken(found: _Tags) -> str:
    """Time of the exposure in ISO 8601, or ""; the tag DateTime has the time at which a program wrote the file."""
    which = "Original" if found.text("DateTimeOriginal") else "Digitized"
    date, _, clock = found.text(f"DateTime{which}").partition(" ")
    fraction = found.text(f"SubSecTime{which}")
    stamp = f"{date.replace(':', '-')}T{clock}" + (f".{fraction}" if fraction.isdecimal() else "")
    try:
        datetime.fromisoformat(stamp)
    except ValueError:  # an unset clock
        return ""
    return stamp


def _color_matrix(found: _Tags) -> tuple[float, ...] | None:
    """The DNG ColorMatrix tag for the illuminant nearest to D65; None without one."""
    choices = {}
    for matrix, illuminant in (("Tag 0xC621", "Tag 0xC65A"), ("Tag 0xC622", "Tag 0xC65B")):
        numbers = found.numbers(matrix)
        if len(numbers) == 9:
            choices[int(found.number(illuminant) or 0)] = tuple(numbers)
    return next((choices[light] for light in (*_D65_FIRST, *choices) if light in choices), None)
