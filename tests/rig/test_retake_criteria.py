"""Which frames are retaken, and which are accepted."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.errors import DecodeError
from polcap.formats.raw import libraw as raw
from polcap.rig import retake_criteria
from polcap.rig.camera import CameraFile
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.retake_criteria import FrameFacts
from tests.raw_files import write_raw
from tests.rig.pool import ANGLES, Key, tiny

SET = Exposure(time_s=0.02, f_number=11.0, iso=100.0)


def facts(digest: str = "a", clipped: float = 0.0, **exif: object) -> FrameFacts:
    tags = {"make": "M", "model": "One", "lens": "L", "exposure_time": 0.02, "f_number": 11.0, "iso": 100.0}
    size = {"width": 96, "height": 72, "focal_length_mm": 60.0}
    return FrameFacts(Exif(**{**tags, **size, **exif}), digest, clipped, 0.5)  # type: ignore[arg-type]


def judged(frame: FrameFacts, *others: FrameFacts, flash: bool = True, shortest: bool = False) -> str | None:
    return retake_criteria.retake_reason(frame, SET, flash, shortest, list(others), sharpest=0.5)


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (facts("a"), "same photograph"),
        (facts("b", exposure_time=0.04), r"exposure time \[s\] 0.04, but 0.02"),
        (facts("b", f_number=16.0), "f-number 16"),
        (facts("b", iso=200.0), "ISO 200"),
        (facts("b", model="Two"), "taken with M Two, not M One"),
        (facts("b", lens="K"), "through K, not L"),
        (facts("b", width=48), "48×72 px, not 96×72 px"),
        (facts("b", focal_length_mm=70.0), "at 70 mm, not 60 mm"),
    ],
)
def test_a_frame_that_differs_is_refused_with_its_reason(frame: FrameFacts, words: str) -> None:
    assert judged(facts("b", exposure_time=1 / 49), facts("a"), shortest=True) is None
    assert re.search(words, judged(frame, facts("a")) or "")


def test_clipping_counts_only_in_the_shortest_exposure_and_the_flash_only_in_ambient_frames() -> None:
    bright = facts("b", clipped=0.02, flash_fired=True)
    assert judged(bright) is None
    assert "2 % of the picture is clipped" in str(judged(bright, shortest=True))
    assert "flash fired" in str(judged(bright, flash=False))


def test_sharpness_is_equal_at_every_angle_and_falls_with_blur(pool: dict[Key, bytes], tmp_path: Path) -> None:
    file = tmp_path / "x.dng"
    for step in (1, 2):
        sharp = []
        for angle in ANGLES:
            file.write_bytes(pool["shot", angle, step])
            sharp.append(retake_criteria.inspect(file)[0].sharpness)
        assert not retake_criteria.is_blurred(min(sharp), max(sharp))
        blur(file, tmp_path / "y.dng", 2.0)
        assert retake_criteria.is_blurred(retake_criteria.inspect(tmp_path / "y.dng")[0].sharpness, max(sharp))


def blur(source: Path, target: Path, sigma_px: float) -> None:
    """Blur each color of a mosaic."""
    value = raw.read(source).value.astype(np.float32)
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        part = value[row::2, column::2]
        value[row::2, column::2] = cv2.GaussianBlur(np.ascontiguousarray(part), (0, 0), sigma_px / 2)
    write_raw(target, np.rint(value).astype(np.uint16), Exif(make="Polcap", model="Synthetic", exposure_time=0.02))


def test_clipped_share_is_counted(tmp_path: Path) -> None:
    mosaic = np.full((40, 60), 3000, np.uint16)
    mosaic[:10, :30] = 15871
    write_raw(tmp_path / "x.dng", mosaic, Exif(make="Polcap"))
    found, small = retake_criteria.inspect(tmp_path / "x.dng")
    assert found.clipped == pytest.approx(300 / 2400)
    assert small.shape == (20, 30) and small[15, 20] == pytest.approx((3000 - 512) / (15871 - 512), rel=1e-4)


def test_a_camera_that_saturates_below_its_white_level_clips(tmp_path: Path) -> None:
    mosaic = np.full((400, 600), 3000, np.uint16)
    mosaic[:100, :300] = 12000
    write_raw(tmp_path / "x.dng", mosaic, Exif(make="Polcap"))
    assert retake_criteria.inspect(tmp_path / "x.dng")[0].clipped == pytest.approx(1 / 8)


def test_another_file_or_half_a_raw_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "x.jpg"), np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(DecodeError, match="set the camera to RAW"):
        retake_criteria.inspect(tmp_path / "x.jpg")
    data = tiny(tmp_path / "y.dng")
    (tmp_path / "y.dng").write_bytes(data[:-200])
    with pytest.raises(DecodeError, match="past the end"):
        retake_criteria.inspect(tmp_path / "y.dng")


@pytest.mark.parametrize(
    ("head", "suffix"),
    [
        (b"\0\0\0\x18ftypcrx ", ".cr3"),
        (b"II\x1a\0\0\0HEAPCCDR", ".crw"),
        (b"FUJIFILMCCD-RAW ", ".raf"),
        (b"IIRO", ".orf"),
        (b"IIU\0", ".rw2"),
        (b"\xff\xd8\xff\xe1", ".jpg"),
        (b"MM\0*" + bytes(40) + b"NIKON CORPORATION", ".nef"),
        (b"II*\0" + bytes(40) + b"SONY", ".arw"),
        (b"something new", ".xyz"),
    ],
)
def test_the_suffix_follows_the_content(head: bytes, suffix: str, tmp_path: Path) -> None:
    assert CameraFile(head + bytes(100), "IMG_1.XYZ", SET).suffix == suffix
    assert CameraFile(tiny(tmp_path / "t.dng"), "x.jpg", SET).suffix == ".dng"
