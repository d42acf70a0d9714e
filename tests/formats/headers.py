"""Headers of file formats without a sample file, built byte by byte for the tests."""

import os
import struct
import zlib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

DATA = Path(os.environ.get("POLCAP_DATA") or "/nonexistent")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="POLCAP_DATA names no folder of real captures")

_FORMS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 7: "s", 10: "ii"}
SUB_IFDS, EXIF_IFD = 330, 34665


def tiff(main, subs=None, magic=b"II*\0", order="<", image=b"", image_tag=273):
    """A TIFF: `main` and each directory of `subs` are {tag: (form, values)}; each of `subs` is at its tag."""
    subs = subs or {}
    offset = len(magic) + 4
    main = dict(main) | dict.fromkeys(subs, (4, (0,)))
    if image:
        main[image_tag] = (4, (0,))
    at = offset + len(_directory(main, order, 0))
    blobs = []
    for tag, directory in subs.items():
        main[tag] = (4, (at,))
        blobs.append(_directory(directory, order, at))
        at += len(blobs[-1])
    if image:
        main[image_tag] = (4, (at,))
    return magic + struct.pack(order + "I", offset) + _directory(main, order, offset) + b"".join(blobs) + image


def _directory(entries, order, start):
    table, tail = [], b""
    start += 2 + 12 * len(entries) + 4
    for tag, (form, values) in sorted(entries.items()):
        if form in (2, 7):
            data = values + (b"\0" if form == 2 else b"")
            count = len(data)
        else:
            flat = [part for value in values for part in _parts(value, form)]
            count = len(values)
            data = struct.pack(order + _FORMS[form] * count, *flat)
        if len(data) > 4:
            cell = struct.pack(order + "I", start + len(tail))
            tail += data + b"\0" * (len(data) % 2)
        else:
            cell = data.ljust(4, b"\0")
        table.append(struct.pack(order + "HHI", tag, form, count) + cell)
    return struct.pack(order + "H", len(table)) + b"".join(table) + b"\0\0\0\0" + tail


def _parts(value, form):
    if form not in (5, 10):
        return (int(value),)
    fraction = Fraction(value).limit_denominator(100000)
    return fraction.numerator, fraction.denominator


def camera(make=b"Acme", model=b"Z1"):
    return {271: (2, make), 272: (2, model), 306: (2, b"2026:01:02 03:04:05")}


def settings(time=1 / 50, f_number=8, iso=200, focal=60, flash=None):
    found = {
        33434: (5, (time,)),
        33437: (5, (f_number,)),
        34855: (3, (iso,)),
        36867: (2, b"2026:01:02 03:04:05"),
        37386: (5, (focal,)),
        37521: (2, b"25"),
        42036: (2, b"Macro 60"),
    }
    return found if flash is None else found | {37385: (3, (flash,))}


def jpeg(exif_tiff):
    body = b"Exif\0\0" + exif_tiff
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(body) + 2) + body + b"\xff\xd9"


def add_chunks(path, *chunks):
    """Add chunks, types and contents, to a PNG behind its header."""
    data = path.read_bytes()
    new = [struct.pack(">I", len(one)) + kind + one + struct.pack(">I", zlib.crc32(kind + one)) for kind, one in chunks]
    path.write_bytes(data[:33] + b"".join(new) + data[33:])


def raf(exif_tiff):
    preview = jpeg(exif_tiff)
    head = b"FUJIFILMCCD-RAW 0201FF129502".ljust(84, b"\0")
    return head + struct.pack(">II", 148, len(preview)) + bytes(56) + preview


def cr3(main, photo):
    def box(name, body):
        return struct.pack(">I", len(body) + 8) + name + body

    canon = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")
    boxes = box(b"CMT1", tiff(main)) + box(b"CMT2", tiff(photo))
    return box(b"ftyp", b"crx \0\0\0\1crx isom") + box(b"moov", box(b"uuid", canon + boxes))


def mrw(exif_tiff):
    def block(name, body):
        return name + struct.pack(">I", len(body)) + body

    blocks = block(b"\0PRD", bytes(24)) + block(b"\0TTW", exif_tiff)
    return block(b"\0MRM", blocks)


def of_picture(pixels):
    """Tags of an uncompressed RGB picture (H, W, C) in a TIFF."""
    height, width, channels = pixels.shape
    return {
        256: (4, (width,)), 257: (4, (height,)), 258: (3, (8 * pixels.itemsize,) * channels), 259: (3, (1,)),
        262: (3, (2,)), 277: (3, (channels,)), 278: (4, (height,)), 279: (4, (pixels.nbytes,)), 284: (3, (1,)),
    }  # fmt: skip


def dng(pixels, photometric=32803, cfa=((0, 1), (1, 2)), black=None, area=None, photo=None, maker=None, **levels):
    """An uncompressed DNG of uint16 (H, W[, C]); `area` = top, left, bottom, right of the visible pixels.

    `black` is a repeating pattern (h, w[, C]), `columns` and `rows` of `levels` are added to it.
    """
    pixels = np.atleast_3d(np.ascontiguousarray(pixels, "<u2"))
    main = (maker or camera()) | of_picture(pixels) | {262: (3, (photometric,))}
    main |= {
        254: (4, (0,)),
        50706: (1, (1, 4, 0, 0)),
        50708: (2, b"Acme Z1"),
        50717: (4, (levels.get("white", 16383),)),
    }
    if photometric == 32803:
        main |= {33421: (3, (len(cfa), len(cfa[0]))), 33422: (1, [c for row in cfa for c in row])}
        main |= {50710: (1, (0, 1, 2)), 50711: (3, (1,))}
    if black is not None:
        main |= {50713: (3, np.shape(black)[:2]), 50714: (5, np.ravel(black).tolist())}
    for tag, name in ((50715, "columns"), (50716, "rows")):
        main |= {tag: (10, levels[name])} if name in levels else {}
    if area is not None:
        main[50829] = (4, area)
    if pixels.shape[2] == 3 or photometric == 32803:
        matrix = (0.9, -0.3, -0.07, -0.45, 1.24, 0.23, -0.09, 0.19, 0.71)
        main |= {50721: (10, matrix), 50728: (5, levels.get("neutral", (0.5, 1, 0.8))), 50778: (3, (21,))}
    return tiff(main, {EXIF_IFD: photo if photo is not None else settings()}, image=pixels.tobytes())
