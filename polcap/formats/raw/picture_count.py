"""Counts the pictures in a photograph's file, to refuse files of several; recognizes gain maps. In the child process.

References
----------
W3C, Portable Network Graphics (third edition), 11.3.4. TIFF 6.0, NewSubfileType. CIPA DC-007, Multi-Picture Format.
Adobe, Digital Negative Specification 1.7, ch. 7. Android, Ultra HDR Image Format 1.1. ISO 21496-1.
"""

import re
import struct
from typing import Any

from polcap.errors import DecodeError
from polcap.formats.raw import file_kind
from polcap.formats.raw.file_kind import Directory, TiffStructure, first

_NO_PICTURE = 0xFFFF & ~2  # bits of NewSubfileType: preview, mask, depth…; 2 is a page
_PREVIEW_SIDE = 0.25  # of the picture's; cameras do not mark all small previews
_GAIN_MAP_MARKS = re.compile(rb"hdrgm:|hdrgainmap|urn:iso:std:iso:ts:21496", re.IGNORECASE)  # in the XMP of a phone
_AUXILIARY_MARKS = re.compile(_GAIN_MAP_MARKS.pattern + rb"|AuxiliaryImageType", re.IGNORECASE)  # depth maps, mattes
_MARKS_BYTES = 1 << 16  # from the beginning of a picture: its headers
_MPF_ENTRIES, _MPF_TYPE = 0xB002, 0xFFFFFF  # tag of the list of pictures; bits of an entry's type
_MPF_AUXILIARY = {0x010001, 0x010002, 0x040000, 0x050000}  # previews, the original, a gain map
_OPCODE_GAIN_MAP = 9
_STACK = re.compile(r"^images=(\d+)", re.MULTILINE)  # ImageJ's stack under one directory
REMEDY = "save each picture as a file of its own"


def check_single(path: str, data: bytes, file: Any) -> None:
    """Refuse a file of several finished pictures; OpenImageIO has opened it as `file`. Raises DecodeError."""
    spec = file.spec()
    if data.startswith(file_kind.EXR):
        count = int(spec.getattribute("oiio:subimages") or 1)
    elif data.startswith(file_kind.PNG):
        count = int.from_bytes(file_kind.png_chunks(data).get(b"acTL", b"\0\0\0\1")[:4], "big")
    elif data.startswith(file_kind.JPEG):
        count = _multi_picture_count(data)
    else:
        pictures = _tiff_pictures(file_kind.structure(data))
        stack = _STACK.search(str(spec.getattribute("ImageDescription") or ""))
        count = max(len(pictures), int(stack[1]) if stack else 1)
    if count > 1:
        number = f"{count} or more" if count == file_kind.MAX_DIRECTORIES else count
        raise DecodeError(f"{path}: holds {number} pictures, of which polcap would read the first only; {REMEDY}")


def check_single_raw(path: str, structure: TiffStructure) -> None:
    """Refuse a RAW of several sensor images of one size, as of a pixel shift or a burst. Raises DecodeError."""
    sizes = [
        (first(one, file_kind.WIDTH), first(one, file_kind.LENGTH))
        for one in _tiff_pictures(structure)
        if first(one, file_kind.PHOTOMETRIC) in (file_kind.CFA, file_kind.LINEAR_RAW)
    ]
    count = sizes.count(max(sizes, default=(0, 0)))
    if count > 1:
        raise DecodeError(f"{path}: holds {count} pictures, of which polcap would read one only; {REMEDY}")


def _tiff_pictures(structure: TiffStructure) -> list[Directory]:
    """Directories of a TIFF's pictures, without previews, masks and directories without pixels.

    A preview in the first place counts, because it is read instead of the picture.
    """
    with_pixels = [one for one in structure.directories if file_kind.strips(one)]
    least_width = _PREVIEW_SIDE * first(with_pixels[0], file_kind.WIDTH) if with_pixels else 0
    others = [
        one
        for one in with_pixels[1:]
        if first(one, file_kind.SUBTYPE) & _NO_PICTURE == 0 and first(one, file_kind.WIDTH) > least_width
    ]
    return with_pixels[:1] + others


def _multi_picture_count(data: bytes) -> int:
    """Number of pictures of a JPEG by its Multi-Picture index, without previews, gain maps and depth maps."""
    base = data.find(b"MPF\0", 0, _MARKS_BYTES) + 4
    if base < 4 or data[base : base + 4] not in file_kind.TIFF:
        return 1
    order = "<" if data[base : base + 2] == b"II" else ">"
    count = 1
    try:
        directory_start = base + struct.unpack_from(order + "I", data, base + 4)[0]
        for k in range(struct.unpack_from(order + "H", data, directory_start)[0]):
            tag, _type, length, offset = struct.unpack_from(order + "HHII", data, directory_start + 2 + 12 * k)
            if tag == _MPF_ENTRIES:
                entries = [
                    struct.unpack_from(order + "III", data, base + offset + 16 * n) for n in range(1, length // 16)
                ]
                count += sum(not _is_auxiliary(kind, data[base + start :][:_MARKS_BYTES]) for kind, _, start in entries)
    except struct.error:  # damaged: nothing is known about more pictures
        return 1
    return count


def _is_auxiliary(kind: int, picture: bytes) -> bool:
    return kind & _MPF_TYPE in _MPF_AUXILIARY or _AUXILIARY_MARKS.search(picture) is not None


def has_gain_map(data: bytes, structure: TiffStructure) -> bool:
    """Whether a JPEG has a gain map, for bright displays, or a DNG has one, against the lens's shading."""
    if data.startswith(file_kind.JPEG):
        return _GAIN_MAP_MARKS.search(data) is not None
    lists = [file_kind.stored_bytes(one, tag) for one in structure.directories for tag in file_kind.OPCODE_LISTS]
    profile = any(one.keys() & set(file_kind.GAIN_TABLES) for one in structure.directories)
    return structure.dng and (profile or any(_OPCODE_GAIN_MAP in _opcodes(one) for one in lists))


def _opcodes(opcode_list: bytes) -> list[int]:
    """Numbers of the operations in one of a DNG's opcode lists; big-endian in every file."""
    found, position = list[int](), 4
    while position + 16 <= len(opcode_list):
        number, _, _, size = struct.unpack_from(">4I", opcode_list, position)
        found.append(number)
        position += 16 + size
    return found
