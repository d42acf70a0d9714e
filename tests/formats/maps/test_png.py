import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from polcap.errors import DecodeError
from polcap.formats.maps import png
from polcap.formats.raw import photo
from tests.formats.raw.test_photo import save


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("tail", [(), (3,), (4,)])
def test_pixels_come_back_in_order(tmp_path: Path, dtype: type[np.uint8], tail: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (5, 7, *tail)).astype(dtype)
    png.write(tmp_path / "a.png", pixels)
    assert np.array_equal(png.read(tmp_path / "a.png"), pixels)
    assert png.encode(pixels) == (tmp_path / "a.png").read_bytes()


def test_red_is_first_for_other_readers_and_alpha_of_a_grey_picture_is_left_out(tmp_path: Path) -> None:
    png.write(tmp_path / "a.png", np.full((2, 2, 3), [255, 10, 0], dtype=np.uint8))
    assert oiio.ImageInput.open(str(tmp_path / "a.png")).read_image(oiio.UINT8)[0, 0].tolist() == [255, 10, 0]
    assert png.read(save(tmp_path / "a.png", np.full((2, 3, 2), [7, 255], np.uint8))).tolist() == [[7] * 3] * 2


def test_only_whole_numbers_are_taken() -> None:
    with pytest.raises(TypeError, match="float32"):
        png.encode(np.zeros((2, 2), dtype=np.float32))  # type: ignore[arg-type]


def test_damaged_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with pytest.raises(DecodeError, match="check the file"):
        png.read(path)
    png.write(path, np.zeros((50, 50), np.uint8))
    for data in (b"", b"\x89PNG\r\n\x1a\nnonsense", path.read_bytes()[:60]):
        path.write_bytes(data)
        with pytest.raises(DecodeError, match=r"a\.png(: | is )(not a|truncated)"):
            png.read(path)


@pytest.mark.parametrize("door", [png.read, photo.read])
def test_more_pixels_than_the_bytes_unpack_to_are_refused_unread(
    tmp_path: Path, door: Callable[[Path], object]
) -> None:
    path = tmp_path / "a.png"
    png.write(path, np.zeros((3000, 3000), np.uint8))  # nothing packs better than one value
    door(path)
    data = path.read_bytes()
    head = b"IHDR" + struct.pack(">II", 15_000, 15_000) + data[24:29]
    path.write_bytes(data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:])
    with pytest.raises(DecodeError, match="cannot hold 15000×15000 px"):
        door(path)


def test_colors_state_srgb_and_data_state_nothing(tmp_path: Path) -> None:
    pixels = np.full((2, 2, 3), 128, np.uint8)
    png.write(tmp_path / "color.png", pixels, srgb=True)
    png.write(tmp_path / "data.png", pixels)
    assert (tmp_path / "color.png").read_bytes()[33:46] == bytes.fromhex("00000001 73524742 01 d9c92c7f")
    assert b"sRGB" not in (tmp_path / "data.png").read_bytes()
    assert np.array_equal(png.read(tmp_path / "color.png"), pixels)
