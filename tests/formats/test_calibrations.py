"""The newest calibration that fits is used, an impossible one is refused."""

import dataclasses
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from polcap.calibration_values import Calibration, Falloff, FlashEnergy, LensGeometry, Levels, NoiseLine, Polarizer
from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import atomic, ball_accuracies, calibrations
from polcap.formats.capture import reader as capture

EXAMPLE = Path(__file__).parents[1] / "capture"
EXIF = Exif(make="Polcap", model="Synthetic", lens="Synthetic 60mm", f_number=11.0, focal_length_mm=60.0)
LINE = NoiseLine(100.0, (3e-5,), (1e-7,), (1e-8,), (1e-9,), (33333.0,), (3.3,))
RING = Polarizer(1.5, 0.05, -1, True, (300.0, 500.0, 200.0), (10.0, 10.0, 10.0), 24)
FALLOFF = Falloff(((-0.2, 0.0, 0.0),), ((0.001, 0.001, 0.001),), (0.8,), 11.0, 60.0)
FLASH = FlashEnergy(0.01, 0.002, 0.0, 0.001, 12)
LENS = LensGeometry(
    1066.7, 0.4, (319.5, 239.5), 0.3, -0.05, 1e-3, 0.01, 2e-3, (640, 480), 0.2, 3.0, 6, "checkerboard", 60.0
)
RIG = ("Polcap Synthetic", "Synthetic 60mm", "B+W")
KNOWN = Calibration("2026-11-22T20:00:00+00:00", *RIG, noise=(LINE,), falloff=FALLOFF, polarizer=RING, flash=FLASH)


@pytest.fixture
def users(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path / "calib"))
    return tmp_path / "calib"


def test_a_calibration_is_read_back_unchanged_and_a_hidden_file_is_none(users):
    assert calibrations.choose(EXIF, None, None) == (None, [])
    path = calibrations.write(users, KNOWN)
    assert calibrations.read(path) == KNOWN
    assert path.name.startswith("2026-11-22")
    (users / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert calibrations.choose(EXIF, None, None)[0] == KNOWN


def test_parts_that_were_not_measured_come_back_as_none(users):
    levels = Levels((512.0,) * 4, (0.1,) * 4, (512.0,) * 4, 15871.0)
    unsaid = dataclasses.replace(FALLOFF, f_number=None, focal_length_mm=None)
    bare = dataclasses.replace(KNOWN, levels=levels, falloff=unsaid, polarizer=None)
    assert calibrations.read(calibrations.write(users, bare)) == bare


def test_newest_of_camera_lens_and_filter_is_chosen(users):
    later = dataclasses.replace(KNOWN, made="2026-12-01T08:00:00+00:00", noise=())
    for one in (KNOWN, later, dataclasses.replace(later, camera="Other X"), dataclasses.replace(later, lens="Other")):
        calibrations.write(users, one)
    assert calibrations.choose(EXIF, None, None)[0] == later
    assert calibrations.choose(EXIF, "B+W", None)[0] == later
    assert calibrations.choose(EXIF, "Hoya", None)[0] is None
    calibrations.write(users, dataclasses.replace(KNOWN, filter="Hoya"))
    nothing, notes = calibrations.choose(EXIF, None, None)
    assert nothing is None and "B+W, Hoya" in notes[0]
    assert calibrations.choose(EXIF, "Hoya", None)[0].filter == "Hoya"
    assert calibrations.choose(Exif(), None, None) == (None, [])


def test_ring_s_angles_and_notes_reach_the_capture(users):
    calibrations.write(users, dataclasses.replace(KNOWN, lens=""))
    read = capture.read(EXAMPLE)
    assert read.calibration is not None
    assert np.degrees(read.angle) == pytest.approx([1.5, 1.5 - 45, 1.5 - 90])
    assert [shot.name for shot in read.shots] == ["0°", "45°", "90°"]
    assert any("polarizer +1.50° ± 0.05°, mirrored" in note for note in read.notes)


def test_falloff_of_another_aperture_is_left_out(users):
    calibrations.write(users, KNOWN)
    found, notes = calibrations.choose(dataclasses.replace(EXIF, f_number=4.0), None, None)
    assert (found.falloff, found.polarizer) == (None, RING)
    assert "another aperture" in notes[-1]


def test_a_folder_that_cannot_be_opened_holds_no_calibration(users, monkeypatch):
    """Such as that of another account whose home folder the environment names."""
    calibrations.write(users, KNOWN)
    monkeypatch.setattr(Path, "glob", Mock(side_effect=PermissionError))
    assert calibrations.choose(EXIF, None, None) == (None, [])
    assert ball_accuracies.choose(EXIF, None) is None


@pytest.mark.parametrize("text", [b"x = ", b"made = 3", b"", b"made = '\xff'"])
def test_a_foreign_file_is_one_clear_line(users, text):
    atomic.write(users / "a.toml", text)
    with pytest.raises(CaptureError, match="not a polcap calibration"):
        calibrations.choose(EXIF, None, None)


@pytest.mark.parametrize(
    "change",
    [
        {"noise": (dataclasses.replace(LINE, slope=(-1.0,)),)},
        {"polarizer": dataclasses.replace(RING, extinction=(0.5, 2.0, 2.0))},
        {"polarizer": dataclasses.replace(RING, sense=2)},
        {"falloff": dataclasses.replace(FALLOFF, coefficient=((-1.0, 0.0, 0.0),))},
        {"flash": dataclasses.replace(FLASH, spread=0.0)},
        {"polarizer": dataclasses.replace(RING, zero_deg=1e300)},
        {"noise": (dataclasses.replace(LINE, iso=0.0),)},
        {"geometry": dataclasses.replace(LENS, size_px=(10**12, 480))},
        {"geometry": dataclasses.replace(LENS, k1=1e300, k2=-1e300)},
        {"geometry": dataclasses.replace(LENS, focal_px=1e-300)},
    ],
)
def test_impossible_figures_are_refused(users, change):
    calibrations.write(users, dataclasses.replace(KNOWN, **change))
    with pytest.raises(CaptureError, match="impossible"):
        calibrations.choose(EXIF, None, None)
