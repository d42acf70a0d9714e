"""Focal length and distortion measured from boards are those of the simulated lens, and undo it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap import calibrate
from polcap.calibration_values import Calibration, LensGeometry
from polcap.capture_values import Exif
from polcap.cli import calibrate_command
from polcap.errors import CaptureError, SettingError
from polcap.formats import calibrations
from polcap.image_values import Distortion
from polcap.optics import distortion
from polcap.synth import calibration_frames
from polcap.synth.calibration_frames import CalibrationShoot

MADE = "2026-11-22T20:00:00+00:00"
SHOOT = CalibrationShoot(
    seed=2, width=576, height=384, isos=(), pops=0, axes_deg=(), boards=7, distortion=(-0.2, 0.1), focal_mm=35.0
)
FOCAL = 35 / 36 * 576


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("lens") / "frames"
    calibration_frames.write(place, SHOOT)
    return place


@pytest.fixture(scope="module")
def found(folder) -> Calibration:
    return calibrate.measure(folder, MADE)


def rays(lens: Distortion, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Directions of photograph pixels, without their mean: the camera's direction does not matter."""
    u, v = distortion.undistort(lens, x, y)
    direction = np.stack([u - lens.center[0], v - lens.center[1]]) / lens.focal
    return direction - direction.mean(axis=(1, 2), keepdims=True)


def test_lens_is_the_simulated_one(found):
    lens = found.geometry
    assert lens.focal_px == pytest.approx(FOCAL, rel=0.01)
    assert abs(lens.focal_px - FOCAL) < 6 * lens.focal_sigma_px
    assert lens.residual_px < 0.25 < lens.pinhole_residual_px
    y, x = np.mgrid[:384:16.0, :576:16.0]
    truth = rays(Distortion(FOCAL, (287.5, 191.5), *SHOOT.distortion), x, y)
    error = FOCAL * np.hypot(*(rays(Distortion(lens.focal_px, lens.principal_px, lens.k1, lens.k2), x, y) - truth))
    before = FOCAL * np.hypot(*(rays(Distortion(FOCAL, (287.5, 191.5), 0.0, 0.0), x, y) - truth))
    assert before.max() > 9
    assert error.mean() < 0.4 and error.max() < 0.1 * before.max()


def test_the_lens_is_printed_and_saved(found, tmp_path):
    assert "lens       5" in "\n".join(calibrate_command.lines(found))
    lens = calibrations.read(calibrations.write(tmp_path, found)).geometry
    assert lens.focal_px == pytest.approx(found.geometry.focal_px, rel=1e-6)
    assert lens.size_px == (576, 384)


@pytest.mark.parametrize(
    ("changes", "taken"), [({}, True), ({"width": 578}, False), ({"focal_length_mm": 50.0}, False)]
)
def test_a_lens_is_used_at_its_focal_length_and_size_only(found, tmp_path, monkeypatch, changes, taken):
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path))
    calibrations.write(tmp_path, found)
    exif = Exif(make="Polcap", model="Synthetic", focal_length_mm=35.0, width=576, height=384)
    chosen, notes = calibrations.choose(replace(exif, **changes), None, None)
    assert (chosen.geometry is not None) == taken
    assert ("its geometry is not used" in notes[-1]) != taken


def test_an_impossible_lens_is_refused(found, tmp_path):
    lens: LensGeometry = replace(found.geometry, k1=-5.0)
    path = calibrations.write(tmp_path, replace(found, geometry=lens))
    with pytest.raises(CaptureError, match="geometry is impossible"):
        calibrations.read(path)


def test_too_few_boards_are_an_error(folder, tmp_path):
    (tmp_path / "lens").mkdir()
    for path in sorted((folder / "lens").iterdir())[:3]:
        (tmp_path / "lens" / path.name).symlink_to(path)
    with pytest.raises(CaptureError, match="3 of 3 photographs show a board, 6 are needed"):
        calibrate.measure(tmp_path, MADE)


@pytest.mark.parametrize("board", ["9", "9x", "1x6", "axb", "9x6x3", "200x6"])
def test_a_wrong_board_option_is_an_error(board):
    with pytest.raises(SettingError, match="inner corners across and down"):
        calibrate_command.parse_board(board)
