"""The DNG writer, read back by LibRaw and exifread, which know nothing of it."""

from pathlib import Path

import exifread
import numpy as np
import pytest
import rawpy

from polcap.capture_values import Exif
from polcap.formats import dng_writer
from polcap.formats.raw import exif

EXIF = Exif(
    make="Polcap", model="Synthetic 1", lens="Synthetic 60 mm", exposure_time=1 / 160, f_number=8.0, iso=200.0,
    focal_length_mm=60.0, focal_length_35mm=90.0, pixel_pitch_um=6.25, taken="2026-03-14T15:57:29.250",
    flash_fired=True,
)  # fmt: skip
PHASES = {"RGGB": [[0, 1], [1, 2]], "BGGR": [[2, 1], [1, 0]], "GRBG": [[1, 0], [2, 1]], "GBRG": [[1, 2], [0, 1]]}
MATRIX = np.array([[0.9, -0.29, -0.07], [-0.45, 1.24, 0.23], [-0.09, 0.19, 0.71]])


def write(path: Path, mosaic: np.ndarray, phase: str = "RGGB", **settings: object) -> Path:
    dng_writer.write(
        path,
        mosaic,
        cfa=np.array(PHASES[phase], np.uint8),
        black=[[510, 511], [512, 513]],
        white=15871,
        exif=Exif(**{**vars(EXIF), **settings}),
        color_matrix=MATRIX,
        as_shot_neutral=np.array([0.5, 1.0, 0.8]),
    )
    return path


def picture(seed: int, height: int = 60, width: int = 84) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    smooth = 4000 + 3000 * np.sin(x / 9) * np.cos(y / 7) + 500 * (x % 2)
    return (smooth + np.random.default_rng(seed).normal(0, 30, smooth.shape)).clip(0, 65535).astype(np.uint16)


@pytest.mark.parametrize("phase", PHASES)
def test_counts_phase_black_and_white_come_back_exactly(tmp_path: Path, phase: str) -> None:
    mosaic = picture(1)
    with rawpy.imread(str(write(tmp_path / "a.DNG", mosaic, phase))) as r:
        np.testing.assert_array_equal(r.raw_image_visible, mosaic)
        assert "".join("RGBG"[i] for i in r.raw_pattern.ravel()) == phase
        blacks = np.array(r.black_level_per_channel)[r.raw_pattern]  # LibRaw's order is R, G, B, G2
        np.testing.assert_array_equal(blacks, [[510, 511], [512, 513]])
        assert r.white_level == 15871
        np.testing.assert_allclose(r.camera_whitebalance[:3], [2, 1, 1.25], rtol=1e-4)


def test_other_readers_find_the_exif(tmp_path: Path) -> None:
    path = write(tmp_path / "a.DNG", picture(3))
    with path.open("rb") as file:
        tags = exifread.process_file(file, details=False)
    number = {k: float(v.values[0]) for k, v in tags.items() if v.values and not isinstance(v.values, str)}
    assert (str(tags["Image Make"]), str(tags["Image Model"])) == ("Polcap", "Synthetic 1")
    assert str(tags["EXIF LensModel"]) == "Synthetic 60 mm"
    assert str(tags["EXIF DateTimeOriginal"]) == "2026:03:14 15:57:29"
    assert str(tags["EXIF SubSecTimeOriginal"]) == "250"
    assert number["EXIF ExposureTime"] == pytest.approx(1 / 160)
    assert number["EXIF FNumber"] == 8 and number["EXIF ISOSpeedRatings"] == 200
    assert number["EXIF FocalLength"] == 60 and number["EXIF FocalLengthIn35mmFilm"] == 90
    assert 1e4 / number["EXIF FocalPlaneXResolution"] == 6.25 and number["EXIF FocalPlaneResolutionUnit"] == 3
    assert int(number["EXIF Flash"]) & 1
    with rawpy.imread(str(path)) as r:
        assert r.other.iso_speed == 200 and r.other.aperture == 8
        assert r.other.shutter_speed == pytest.approx(1 / 160)


@pytest.mark.parametrize(
    ("turn", "words"), [(0, "Horizontal"), (90, "Rotated 90 CCW"), (180, "Rotated 180"), (270, "Rotated 90 CW")]
)
def test_orientation_is_a_tag_and_moves_no_pixel(tmp_path: Path, turn: int, words: str) -> None:
    path = write(tmp_path / "a.DNG", picture(3), upright_deg=turn)
    with path.open("rb") as file:
        assert words in str(exifread.process_file(file, details=False)["Image Orientation"])
    assert exif.tags(path.read_bytes()).upright_deg == turn
    with rawpy.imread(str(path)) as r:
        np.testing.assert_array_equal(r.raw_image_visible, picture(3))


def test_facts_not_known_are_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "a.DNG", picture(3), exposure_time=None, flash_fired=None, pixel_pitch_um=None)
    with path.open("rb") as file:
        tags = exifread.process_file(file, details=False)
    assert not {"EXIF ExposureTime", "EXIF Flash", "EXIF FocalPlaneXResolution"} & set(tags)
    with rawpy.imread(str(path)) as r:
        np.testing.assert_array_equal(r.raw_image_visible, picture(3))


def test_same_counts_give_the_same_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "a", picture(4)).read_bytes() == write(tmp_path / "b", picture(4)).read_bytes()
