"""Files of several pictures are refused with their number; gain maps are recognized."""

import struct
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from polcap.errors import DecodeError
from polcap.formats.raw import file_kind, photo, picture_count, probe
from tests.formats import headers

PIXELS = np.random.default_rng(1).integers(0, 65535, (24, 32, 3)).astype(np.uint16)
REDUCED, PAGE, MASK = 1, 2, 4  # NewSubfileType of TIFF 6.0


def pages(path: Path, count: int) -> None:
    out = oiio.ImageOutput.create(str(path))
    for number in range(count):
        spec = oiio.ImageSpec(32, 24, 3, "uint16")
        assert out.open(str(path), spec, "AppendSubimage" if number else "Create") and out.write_image(PIXELS)
    out.close()


def sub_pictures(path: Path, *kinds: tuple[int, int]) -> None:
    """A TIFF with a picture of 32 px, and another one of each (NewSubfileType, width), in a directory of its own."""
    # a file that begins with the pixels, so that all directories can point at them
    start, blocks = 8 + PIXELS.nbytes, list[bytes]()
    for kind, width in ((0, 32), *kinds):
        tags = headers.of_picture(PIXELS) | {254: (4, (kind,)), 256: (4, (width,)), 273: (4, (8,))}
        blocks.append(headers._directory(tags, "<", start + sum(map(len, blocks))))
    data = bytearray(struct.pack("<2sHI", b"II", 42, start) + PIXELS.tobytes())
    for block in blocks:
        at, entries = len(data), struct.unpack_from("<H", block)[0]
        data += block
        if block is not blocks[-1]:
            struct.pack_into("<I", data, at + 2 + 12 * entries, at + len(block))
    path.write_bytes(data)


def parts(path: Path, count: int) -> None:
    specs = [oiio.ImageSpec(32, 24, 3, "half") for _ in range(count)]
    for number, spec in enumerate(specs):
        spec["oiio:subimagename"] = f"part{number}"
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), specs)
    for number, spec in enumerate(specs):
        assert number == 0 or out.open(str(path), spec, "AppendSubimage")
        assert out.write_image(PIXELS / np.float32(65535))
    out.close()


def animation(path: Path, frames: int) -> None:
    assert cv2.imwrite(str(path), PIXELS)
    headers.add_chunks(path, (b"acTL", struct.pack(">II", frames, 0)))


def multi_picture(path: Path, *others: tuple[int, bytes]) -> None:
    """A JPEG with a Multi-Picture index (CIPA DC-007) of itself and others, each a type and bytes of its header."""
    assert cv2.imwrite(str(path), (PIXELS >> 8).astype(np.uint8))
    data = path.read_bytes()
    size = 8 + 2 + 12 + 4 + 16 * (1 + len(others))
    at = len(data) + 4 + 4 + size - (2 + 4 + 4)  # of the first other picture, from the index
    entries = struct.pack("<IIIHH", 0x030000, len(data), 0, 0, 0)
    for kind, header in others:
        entries += struct.pack("<IIIHH", kind, len(header), at, 0, 0)
        at += len(header)
    index = struct.pack("<2sHIHHHII", b"II", 42, 8, 1, 0xB002, 7, len(entries), 26) + bytes(4) + entries
    segment = b"\xff\xe2" + struct.pack(">H", len(index) + 6) + b"MPF\0" + index
    path.write_bytes(data[:2] + segment + data[2:] + b"".join(header for _, header in others))


@pytest.mark.parametrize(
    ("name", "write", "count"),
    [
        ("a.tif", lambda path: pages(path, 3), "3"),
        ("b.tif", lambda path: pages(path, 80), "64 or more"),
        ("c.tif", lambda path: sub_pictures(path, (PAGE, 32)), "2"),
        ("d.exr", lambda path: parts(path, 3), "3"),
        ("e.png", lambda path: animation(path, 9), "9"),
        ("f.jpg", lambda path: multi_picture(path, (0x020002, b"\xff\xd8"), (0, b"\xff\xd8")), "3"),
    ],
)
def test_a_file_of_several_pictures_is_refused_with_their_number(tmp_path, name, write, count):
    write(tmp_path / name)
    for read in (probe.read, photo.read):
        with pytest.raises(DecodeError, match=rf"{name}: holds {count} pictures, of which polcap would read the first"):
            read(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("one.tif", lambda path: pages(path, 1)),
        ("pyramid.tif", lambda path: sub_pictures(path, (REDUCED, 16), (REDUCED, 8))),
        ("mask.tif", lambda path: sub_pictures(path, (MASK, 32))),
        ("thumbnail.tif", lambda path: sub_pictures(path, (0, 8))),
        ("one.exr", lambda path: parts(path, 1)),
        ("still.png", lambda path: animation(path, 1)),
        ("phone.jpg", lambda path: multi_picture(path, (0x010001, b"\xff\xd8"), (0, b"\xff\xd8 hdrgm:Version='1.0'"))),
    ],
)
def test_previews_masks_and_gain_maps_are_no_pictures(tmp_path, name, write):
    write(tmp_path / name)
    assert probe.read(tmp_path / name).kind == "photo"
    photo.read(tmp_path / name)


def test_a_raw_of_several_exposures_is_refused_with_their_number():
    sensor: file_kind.Directory = {
        file_kind.PHOTOMETRIC: (file_kind.CFA,),
        file_kind.WIDTH: (96,),
        file_kind.LENGTH: (64,),
    }
    sensor |= {file_kind.STRIP_OFFSETS: (8,), file_kind.STRIP_BYTES: (12,), file_kind.SUBTYPE: (0,)}
    preview = sensor | {file_kind.PHOTOMETRIC: (2,), file_kind.SUBTYPE: (REDUCED,), file_kind.WIDTH: (200,)}
    small = sensor | {file_kind.WIDTH: (48,)}
    picture_count.check_single_raw("a.dng", file_kind.TiffStructure((preview, sensor, small), 100))
    with pytest.raises(DecodeError, match=r"a\.dng: holds 4 pictures"):
        picture_count.check_single_raw("a.dng", file_kind.TiffStructure((preview, *[sensor] * 4), 100))


def opcode_list(*numbers: int) -> bytes:
    """A DNG's opcode list: number, version, flags, size and parameters of each operation; big-endian."""
    operations = [struct.pack(">4I", number, 0x01030000, 0, 8) + bytes(8) for number in numbers]
    return struct.pack(">I", len(numbers)) + b"".join(operations)


@pytest.mark.parametrize(
    ("tags", "has"),
    [
        ({}, False),
        ({51009: (7, opcode_list(4, 9))}, True),  # OpcodeList2: bad pixels, GainMap
        ({51008: (7, opcode_list(1, 4))}, False),
        ({51009: (3, (9, 999)), 50827: (3, (400, 5))}, False),  # damaged
        ({52525: (7, bytes(300_000))}, True),  # ProfileGainTableMap
    ],
)
def test_a_gain_map_of_a_dng_is_recognized(tmp_path, tags, has):
    (tmp_path / "a.dng").write_bytes(headers.dng(PIXELS[..., 0], maker=headers.camera() | tags))
    assert probe.read(tmp_path / "a.dng").gain_map is has


@pytest.mark.parametrize("others", [(), ((0, b"\xff\xd8 hdrgm:Version='1.0'"),)])
def test_a_gain_map_of_a_jpeg_is_recognized(tmp_path, others):
    multi_picture(tmp_path / "a.jpg", *others)
    assert probe.read(tmp_path / "a.jpg").gain_map is bool(others)
