"""The noise measured from a bracket of a still scene is that of the simulated sensor."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from polcap import calibrate
from polcap.calibrate import bracket_noise
from polcap.errors import CaptureError
from polcap.synth import scenes, shooting
from polcap.synth.forward_camera import Sensor

SENSOR = Sensor(full_well=12000.0, read_noise=8.0)
MADE = "2026-11-22T20:00:00+00:00"


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """Three exposures of an object and a chart at each of two angles."""
    place = tmp_path_factory.mktemp("bracket") / "bracket"
    shoot = shooting.Shoot(seed=4, width=640, height=480, samples=1, angles_deg=(0.0, 90.0), sensor=SENSOR)
    shooting.write(place, scenes.random_scene(4, "bumps"), shoot)
    for truth in place.glob("truth.*"):
        truth.unlink()
    return place


def test_noise_of_a_bracket_is_the_sensor_s(capture):
    (line,) = calibrate.measure(capture.parent, MADE).noise
    assert (line.iso, line.source) == (100, "bracket")
    assert line.electrons_at_white == pytest.approx([SENSOR.full_well] * 3, rel=0.06)
    count = (SENSOR.full_well / (SENSOR.white - SENSOR.black)) ** 2 / 12  # e⁻², variance of rounding
    read = np.hypot(SENSOR.read_noise, np.sqrt(count))
    assert line.read_noise_electrons == pytest.approx([read] * 3, rel=0.05)
    slope = np.array([1, 0.5, 1]) / SENSOR.full_well
    assert np.abs((np.array(line.slope) - slope) / line.slope_sigma).max() < 5
    assert max(line.slope_sigma / slope) < 0.1


def test_a_camera_that_moved_is_an_error(capture, tmp_path):
    """The simulated camera moves between the angles."""
    frames = sorted(capture.glob("pol*/*.DNG"))
    for number in (0, 4):
        shutil.copy(frames[number], tmp_path)
    with pytest.raises(CaptureError, match="the camera moved between 1 of them"):
        bracket_noise.measure(bracket_noise.brackets(tmp_path))


def test_a_single_exposure_is_an_error(capture, tmp_path):
    shutil.copy(next(capture.glob("pol000/*.DNG")), tmp_path)
    with pytest.raises(CaptureError, match="no two well exposed frames share an ISO"):
        bracket_noise.measure(bracket_noise.brackets(tmp_path))


def test_hidden_files_are_ignored(capture, tmp_path):
    shutil.copytree(capture / "pol000", tmp_path / "one")
    for hidden in (tmp_path / ".DS_Store", tmp_path / "one" / "._frame_1.DNG"):
        hidden.write_bytes(b"\0\5\x16\7")
    (bracket,) = bracket_noise.brackets(tmp_path)
    assert len(bracket) == 3


def test_an_empty_folder_is_an_error(tmp_path):
    with pytest.raises(CaptureError, match="holds no bracket"):
        bracket_noise.brackets(tmp_path)
