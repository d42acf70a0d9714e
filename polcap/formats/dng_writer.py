"""Writes a Bayer or X-Trans mosaic as an uncompressed DNG: a little-endian TIFF.

References
----------
Adobe, Digital Negative Specification 1.4.
"""

import struct
from collections.abc import Sequence
from datetime import datetime
from fractions import Fraction
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polcap.capture_values import Exif
from polcap.formats import atomic
from polcap.formats.raw.exif import UPRIGHT_DEG
from polcap.image_values import Bits, Floats

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10  # TIFF's types of values
_CODE = {_SHORT: "H", _LONG: "I", _RATIONAL: "II", _SRATIONAL: "ii"}
_D65, _CENTIMETRE = 21, 3  # EXIF's LightSource and FocalPlaneResolutionUnit
_Entry = tuple[int, int, Any]  # tag, type, value or values


def write(
    path: Path,
    mosaic: NDArray[np.uint16],
    *,
    cfa: Bits,
    black: ArrayLike,
    white: float,
    exif: Exif,
    color_matrix: Floats,
    as_shot_neutral: Floats,
) -> None:
    """Write a mosaic (H, W) of even sides as a DNG, every count unchanged; after a failure no file is left.

    cfa : (2, 2) or (6, 6) of 0 R, 1 G, 2 B. black : counts, one or (2, 2). white : counts.
    color_matrix : (3, 3) XYZ under D65 → camera. as_shot_neutral : (3,) camera values of a grey.
    exif : camera settings; width, height and color_matrix in it are not used.

    Raises ValueError: the mosaic is not uint16, or its sides are odd.
    """
    height, width = mosaic.shape
    if mosaic.dtype != np.uint16 or height % 2 or width % 2:
        raise ValueError(f"a DNG mosaic is uint16 with even sides, not {mosaic.dtype} {width}×{height}")
    image = mosaic.astype("<u2").tobytes()
    main = [
        *_layout_tags(width, height),
        *_camera_tags(exif),
        (33421, _SHORT, np.shape(cfa)),  # CFARepeatPatternDim
        (33422, _BYTE, bytes(np.asarray(cfa, np.uint8).ravel())),  # CFAPattern
        (50714, _RATIONAL, np.broadcast_to(black, (2, 2)).ravel()),  # BlackLevel
        (50717, _LONG, int(white)),  # WhiteLevel
        (50721, _SRATIONAL, np.asarray(color_matrix).ravel()),  # ColorMatrix1
        (50728, _RATIONAL, as_shot_neutral),  # AsShotNeutral
        (50778, _SHORT, _D65),  # CalibrationIlluminant1
    ]
    # the length of the directory does not depend on the two offsets in it
    start = 8 + len(_ifd(main, 8))
    exif_ifd = _ifd(_exif_tags(exif), start)
    offsets = {34665: start, 273: start + len(exif_ifd)}
    main = [(tag, kind, offsets.get(tag, value)) for tag, kind, value in main]
    atomic.write(path, b"II*\0" + struct.pack("<I", 8) + _ifd(main, 8) + exif_ifd + image)


def _layout_tags(width: int, height: int) -> list[_Entry]:
    """TIFF tags for an image in one strip of 16 bits per pixel, without masked borders."""
    return [
        (254, _LONG, 0),  # NewSubfileType: the full image
        (256, _LONG, width),  # ImageWidth
        (257, _LONG, height),  # ImageLength
        (258, _SHORT, 16),  # BitsPerSample
        (259, _SHORT, 1),  # Compression: none
        (262, _SHORT, 32803),  # PhotometricInterpretation: color filter array
        (273, _LONG, 0),  # StripOffsets, set by the caller
        (277, _SHORT, 1),  # SamplesPerPixel
        (278, _LONG, height),  # RowsPerStrip
        (279, _LONG, 2 * width * height),  # StripByteCounts
        (284, _SHORT, 1),  # PlanarConfiguration
        (34665, _LONG, 0),  # Exif directory, set by the caller
        (50706, _BYTE, bytes((1, 4, 0, 0))),  # DNGVersion
        (50707, _BYTE, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        (50710, _BYTE, bytes((0, 1, 2))),  # CFAPlaneColor
        (50711, _SHORT, 1),  # CFALayout
        (50713, _SHORT, (2, 2)),  # BlackLevelRepeatDim
        (50718, _RATIONAL, (1, 1)),  # DefaultScale
        (50719, _LONG, (0, 0)),  # DefaultCropOrigin
        (50720, _LONG, (width, height)),  # DefaultCropSize
    ]


def _camera_tags(exif: Exif) -> list[_Entry]:
    return [
        (271, _ASCII, exif.make),  # Make
        (272, _ASCII, exif.model),  # Model
        (274, _SHORT, next(tag for tag, turn in UPRIGHT_DEG.items() if turn == exif.upright_deg)),  # Orientation
        (305, _ASCII, "polcap"),  # Software
        (306, _ASCII, _stamp(exif, "%Y:%m:%d %H:%M:%S")),  # DateTime
        (50708, _ASCII, exif.camera or "unknown"),  # UniqueCameraModel
    ]


def _exif_tags(exif: Exif) -> list[_Entry]:
    pitch = exif.pixel_pitch_um
    return [
        (33434, _RATIONAL, exif.exposure_time),  # ExposureTime
        (33437, _RATIONAL, exif.f_number),  # FNumber
        (34855, _SHORT, exif.iso and round(exif.iso)),  # ISOSpeedRatings
        (36864, _UNDEFINED, b"0231"),  # ExifVersion
        (36867, _ASCII, _stamp(exif, "%Y:%m:%d %H:%M:%S")),  # DateTimeOriginal
        (37385, _SHORT, exif.flash_fired if exif.flash_fired is None else int(exif.flash_fired)),  # Flash
        (37386, _RATIONAL, exif.focal_length_mm),  # FocalLength
        (37521, _ASCII, (_stamp(exif, "%f") or "")[:3] or None),  # SubSecTimeOriginal
        (41486, _RATIONAL, pitch and 1e4 / pitch),  # FocalPlaneXResolution, px per cm
        (41487, _RATIONAL, pitch and 1e4 / pitch),  # FocalPlaneYResolution
        (41488, _SHORT, pitch and _CENTIMETRE),  # FocalPlaneResolutionUnit
        (41989, _SHORT, exif.focal_length_35mm and round(exif.focal_length_35mm)),  # FocalLengthIn35mmFilm
        (42036, _ASCII, exif.lens),  # LensModel
    ]


def _stamp(exif: Exif, form: str) -> str | None:
    """Time of the exposure in a format of `strftime`; None if it is unknown."""
    return datetime.fromisoformat(exif.taken).strftime(form) if exif.taken else None


def _ifd(entries: list[_Entry], offset: int) -> bytes:
    """Encode a TIFF directory at byte `offset`, followed by its long values; entries without a value are left out."""
    valued = sorted((entry for entry in entries if entry[2] is not None), key=itemgetter(0))
    encoded = [(tag, kind, *_encode(kind, value)) for tag, kind, value in valued]
    present = [entry for entry in encoded if entry[3] != b"\0" or entry[1] != _ASCII]  # without empty texts
    values_start = offset + 2 + 12 * len(present) + 4
    head, tail = struct.pack("<H", len(present)), b""
    for tag, kind, count, data in present:
        if len(data) <= 4:
            place = data.ljust(4, b"\0")
        else:
            place = struct.pack("<I", values_start + len(tail))
            tail += data + b"\0" * (len(data) % 2)
        head += struct.pack("<HHI", tag, kind, count) + place
    return head + b"\0\0\0\0" + tail


def _encode(kind: int, value: Any) -> tuple[int, bytes]:
    """Number of values of a TIFF entry, and their bytes."""
    if kind == _ASCII:
        value = value.encode() + b"\0"
    if isinstance(value, bytes):
        return len(value), value
    values: Sequence[Any] = np.atleast_1d(value).tolist()
    if kind in (_RATIONAL, _SRATIONAL):
        pairs = [Fraction(v).limit_denominator(100000) for v in values]
        return len(values), b"".join(struct.pack(f"<{_CODE[kind]}", *p.as_integer_ratio()) for p in pairs)
    return len(values), struct.pack(f"<{len(values)}{_CODE[kind]}", *values)
