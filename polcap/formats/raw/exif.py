"""Camera settings from a photograph's EXIF: every maker's RAW, and finished pictures. In the child process.

Only tags are read, about a millisecond per file; the pixel count comes from the decoder.
"""

import io
import logging
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from typing import Any

from polcap.images import Exif

_D65_FIRST = (21, 20, 22, 23, 1, 4, 9, 10, 11, 12, 13, 14, 15)  # EXIF LightSource, the daylights
_UNIT_MM = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit; 1 "none" is inch in practice
_SENSOR_MM = (2.0, 70.0)  # plausible widths; others come from a wrong unit
_RESIZED = 1.12  # ratio of pixel counts above which a picture was resized, not cropped; mRAW has 4/3
_TEXT_LENGTH = 100  # of a name; the rest is cut

logging.getLogger("exifread").setLevel(logging.CRITICAL)  # its warnings are about tags that are not used here


def tags(data: bytes) -> Exif:
    """The settings that the tags state, with their own image width; an empty Exif without EXIF."""
    found = _found(data)
    width = _number(found, "Image Tag 0xC791", "EXIF ExifImageWidth")
    return replace(_exif(found), width=int(width) if width else None)


def sized(stated: Exif, width: int, height: int) -> Exif:
    """The same with the decoder's size in visible RAW pixels, and the pitch of those pixels."""
    pitch = _pitch(stated.pixel_pitch_um, stated.width, width)
    return replace(stated, width=width, height=height, pixel_pitch_um=pitch)


def _found(data: bytes) -> dict[str, Any]:
    """The tags by name, those of the first directory as "Image …"."""
    import exifread

    found: dict[str, Any] = {}
    for prefix, part in _parts(io.BytesIO(data)):
        try:
            read_tags = exifread.process_file(part, details=False, extract_thumbnail=False)
        except Exception:  # exifread documents no errors of its own for a damaged tag: taken as absent
            continue
        found |= {name.replace("Image ", prefix, 1) if prefix else name: tag for name, tag in read_tags.items()}
    return found


def _parts(file: io.BytesIO) -> Iterator[tuple[str, io.BytesIO]]:
    """Prefix for the tag names, and bytes that exifread understands, of each part of a file that holds EXIF."""
    head = file.read(92)
    if head[:15] == b"FUJIFILMCCD-RAW" and len(head) == 92:  # EXIF in the preview
        offset, length = struct.unpack_from(">II", head, 84)
        file.seek(offset)
        yield "", io.BytesIO(file.read(length))
    elif head[4:12] == b"ftypcrx ":  # Canon CR3: EXIF in boxes of its own
        top = head + file.read(1 << 20)
        for box, prefix in ((b"CMT1", ""), (b"CMT2", "EXIF ")):
            at = top.find(box)
            if at >= 4:
                (length,) = struct.unpack_from(">I", top, at - 4)
                yield prefix, io.BytesIO(top[at + 4 : at - 4 + length])
    elif head[:4] == b"\0MRM" and len(head) >= 8:  # Minolta MRW: EXIF in a block
        (length,) = struct.unpack_from(">I", head, 4)
        file.seek(8)
        top = file.read(min(length, 1 << 24))
        at = 0
        while at + 8 <= len(top):
            (length,) = struct.unpack_from(">I", top, at + 4)
            if top[at : at + 4] == b"\0TTW":
                yield "", io.BytesIO(top[at + 8 : at + 8 + length])
                return
            at += 8 + length
    else:
        file.seek(0)
        yield "", file


def _exif(found: Mapping[str, Any]) -> Exif:
    time = _number(found, "EXIF ExposureTime", "Image ExposureTime")
    speed = _number(found, "EXIF ShutterSpeedValue", "Image ShutterSpeedValue")
    if not time and speed is not None and abs(speed) < 30:
        time = 2.0**-speed  # APEX
    flash = _number(found, "EXIF Flash", "Image Flash")
    return Exif(
        make=_text(found, "Image Make"),
        model=_text(found, "Image Model"),
        lens=_text(found, "EXIF LensModel", "Image LensModel"),
        exposure_time=time or None,
        f_number=_number(found, "EXIF FNumber", "Image FNumber") or None,
        iso=_iso(found),
        focal_length_mm=_number(found, "EXIF FocalLength", "Image FocalLength") or None,
        focal_length_35mm=_number(found, "EXIF FocalLengthIn35mmFilm", "Image FocalLengthIn35mmFilm") or None,
        pixel_pitch_um=_plane_pitch(found),
        taken=_taken(found),
        flash_fired=None if flash is None else bool(int(flash) & 1),
        color_matrix=_color_matrix(found),
    )


def _iso(found: Mapping[str, Any]) -> float | None:
    """ISO; 65535 means a value above 16 bits, which is in another tag; of a pair (0, 200) the second counts."""
    names = ("EXIF ISOSpeedRatings", "Image ISOSpeedRatings", "Image Tag 0x0017")  # the last: RW2
    beyond = ("EXIF RecommendedExposureIndex", "EXIF StandardOutputSensitivity", "EXIF ISOSpeed")
    numbers = [number for name in (*names, *beyond) for number in _numbers(found, name)]
    return next((number for number in numbers if 0 < number != 65535), None)


def _plane_pitch(found: Mapping[str, Any]) -> float | None:
    resolution = _number(found, "EXIF FocalPlaneXResolution", "Image FocalPlaneXResolution")
    unit = _number(found, "EXIF FocalPlaneResolutionUnit", "Image FocalPlaneResolutionUnit")
    millimetres = _UNIT_MM.get(int(unit) if unit is not None else 2)
    return 1e3 * millimetres / resolution if resolution and millimetres else None


def _pitch(pitch: float | None, reference_width: int | None, width: int) -> float | None:
    """The pitch of the file's pixels; the tag's is that of the picture before it was resized."""
    if pitch is None:
        return None
    ratio = (reference_width or width) / width
    if max(ratio, 1 / ratio) > _RESIZED:
        pitch *= ratio
    return pitch if _SENSOR_MM[0] < pitch * width / 1e3 < _SENSOR_MM[1] else None


def _taken(found: Mapping[str, Any]) -> str:
    stamp = _text(found, "EXIF DateTimeOriginal", "Image DateTimeOriginal", "Image DateTime")
    fraction = _text(found, "EXIF SubSecTimeOriginal", "Image SubSecTimeOriginal")
    date, _, clock = stamp.partition(" ")
    stamp = f"{date.replace(':', '-')}T{clock}" + (f".{fraction}" if fraction.isdecimal() else "")
    try:
        datetime.fromisoformat(stamp)
    except ValueError:  # an unset clock
        return ""
    return stamp


def _color_matrix(found: Mapping[str, Any]) -> tuple[float, ...] | None:
    """DNG ColorMatrix of the illuminant nearest to D65."""
    choices = {}
    for matrix, illuminant in (("C621", "C65A"), ("C622", "C65B")):
        numbers = _numbers(found, f"Image Tag 0x{matrix}")
        if len(numbers) == 9:
            choices[int(_number(found, f"Image Tag 0x{illuminant}") or 0)] = tuple(numbers)
    for light in (*_D65_FIRST, *choices):
        if light in choices:
            return choices[light]
    return None


def _number(found: Mapping[str, Any], *names: str) -> float | None:
    for name in names:
        numbers = _numbers(found, name)
        if numbers:
            return numbers[0]
    return None


def _numbers(found: Mapping[str, Any], name: str) -> list[float]:
    if name not in found:
        return []
    values = found[name].values
    try:
        numbers = [float(value) for value in (values if isinstance(values, list | tuple) else [values])]
    except (ValueError, TypeError, ZeroDivisionError):  # "unknown" is written 0/0
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def _text(found: Mapping[str, Any], *names: str) -> str:
    for name in names:
        if name in found:
            # printable only: a name goes to the terminal, the report and other files
            text = "".join(c for c in str(found[name].values) if c.isprintable()).strip()[:_TEXT_LENGTH]
            if text:
                return text
    return ""
