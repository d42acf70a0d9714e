import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from polcap.errors import DecodeError, StorageError
from polcap.formats.maps import exr
from polcap.formats.raw import photo


def test_named_channels_and_attributes_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    channels = {name: rng.normal(size=(9, 13)).astype(np.float32) for name in ("S0.R", "S0.G", "S2.B")}
    exr.write(tmp_path / "a.exr", channels, {"unit": "m", "near": 0.5})
    read, header = exr.read(tmp_path / "a.exr"), oiio.ImageBuf(str(tmp_path / "a.exr")).spec()
    assert set(read) == set(channels)
    assert all(np.array_equal(read[name], channels[name]) for name in channels)
    assert header["unit"] == "m" and header["near"] == pytest.approx(0.5)


def test_half_keeps_eleven_bits_and_stays_finite(tmp_path: Path) -> None:
    value = np.array([[0.1, 1e-3, 1e6, -1e6, np.nan]], dtype=np.float32)
    exr.write(tmp_path / "a.exr", {"Y": value}, half=True)
    read = exr.read(tmp_path / "a.exr")["Y"][0]
    assert np.allclose(read[:2], value[0, :2], rtol=2**-11)
    assert read[2:4].tolist() == [65504, -65504] and np.isnan(read[4])


def test_same_input_gives_the_same_bytes(tmp_path: Path, rng: np.random.Generator) -> None:
    channels = {"R": rng.normal(size=(40, 30)), "G": rng.normal(size=(40, 30))}
    exr.write(tmp_path / "a.exr", channels)
    time.sleep(1.1)  # a file's own date counts in seconds
    exr.write(tmp_path / "b.exr", channels)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_file_has_openexr_s_magic_number_and_its_channels_in_alphabetical_order(tmp_path: Path) -> None:
    exr.write(tmp_path / "a.exr", {"R": np.zeros((2, 2)), "B": np.zeros((2, 2))})
    data = (tmp_path / "a.exr").read_bytes()
    assert int.from_bytes(data[:4], "little") == 20000630
    assert data.index(b"B\0", data.index(b"chlist")) < data.index(b"R\0", data.index(b"chlist"))


def test_cut_and_missing_files_are_one_line(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.exr"
    with pytest.raises(DecodeError, match="cannot be read"):
        exr.read(path)
    exr.write(path, {"Y": rng.normal(size=(200, 200))})
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(DecodeError) as caught:
        exr.read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("door", [exr.read, photo.read])
def test_bytes_that_are_no_text_are_left_out_of_a_message(tmp_path: Path, door: Callable[[Path], object]) -> None:
    path = tmp_path / "a.exr"
    exr.write(path, {name: np.ones((8, 8)) for name in "RGB"})
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"lineOrder\0lineOrder", b"lineOrder\0l\xa0$dzrder"))  # the type is repeated
    door(path)  # the pixels are whole
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DecodeError) as caught:
        door(path)
    assert str(caught.value).isprintable()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full to play a full disk")
def test_full_disk_is_reported_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    def onto_full_disk(self: Path, **_: object) -> None:
        os.symlink("/dev/full", self)

    monkeypatch.setattr(Path, "touch", onto_full_disk)
    with pytest.raises(StorageError, match="cannot write"):
        exr.write(tmp_path / "a.exr", {"Y": rng.normal(size=(200, 200))})
    assert list(tmp_path.iterdir()) == []
