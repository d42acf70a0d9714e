"""`polcap calibrate` measures a simulated set-up truly, within the errors that it states."""

import json
from pathlib import Path

import numpy as np
import pytest

from polcap import calibrate
from polcap.calibrate import calibration_photographs
from polcap.calibration_values import Calibration
from polcap.capture_values import Exif
from polcap.cli import calibrate_command
from polcap.errors import CaptureError, InputError
from polcap.formats import calibrations
from polcap.synth import calibration_frames, forward_camera
from polcap.synth.calibration_frames import CalibrationShoot
from tests.raw_files import write_raw

MADE = "2026-11-22T20:00:00+00:00"
SHOOT = CalibrationShoot(seed=3, zero_deg=1.7, sense=-1, black_error=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("calibration") / "frames"
    calibration_frames.write(place, SHOOT)
    return place


@pytest.fixture(scope="module")
def found(folder) -> Calibration:
    return calibrate.measure(folder, MADE, "B+W")


def test_electrons_at_white_are_those_of_the_sensor(found):
    assert [line.iso for line in found.noise] == [100, 400]
    for line in found.noise:
        electrons = SHOOT.sensor.full_well * 100 / line.iso
        assert line.electrons_at_white == pytest.approx([electrons] * 3, rel=0.03)
        assert line.read_noise_electrons == pytest.approx([SHOOT.sensor.read_noise] * 3, rel=0.15)


def test_noise_errors_are_as_large_as_stated(found):
    pull = []
    for line in found.noise:
        slope = np.array([1, 0.5, 1]) * line.iso / 100 / SHOOT.sensor.full_well  # a green pixel is two photosites
        pull += list((np.array(line.slope) - slope) / np.array(line.slope_sigma))
    assert np.abs(pull).max() < 4
    assert 0.2 < np.std(pull) < 2.5


def test_black_is_measured_where_the_tags_are_wrong(found):
    assert found.levels.black == pytest.approx([SHOOT.sensor.black + 1.0] * 4, abs=0.1)
    assert found.levels.black_stated == (SHOOT.sensor.black,) * 4


def test_falloff_is_the_lens_s_and_not_the_lamp_s(found):
    corner = 1 + sum(SHOOT.falloff)
    assert found.falloff.corner == pytest.approx([corner] * 3, abs=0.01)
    r2 = np.linspace(0, 1, 11)
    truth = 1 + SHOOT.falloff[0] * r2 + SHOOT.falloff[1] * r2**2
    for a, b, c in found.falloff.coefficient:
        assert 1 + a * r2 + b * r2**2 + c * r2**3 == pytest.approx(truth, abs=0.01)


def test_a_linear_sensor_is_linear(found):
    assert found.linearity.power == pytest.approx(1, abs=0.005)
    assert found.linearity.greatest_deviation < 0.01


def test_zero_sense_and_extinction_of_the_ring(found):
    ring = found.polarizer
    assert (ring.sense, ring.sense_known) == (-1, True)
    assert ring.zero_deg == pytest.approx(SHOOT.zero_deg, abs=0.2)
    assert ring.zero_sigma_deg < 0.1
    assert ring.extinction == pytest.approx(SHOOT.extinction, rel=0.10)


def test_spread_of_the_flash(found):
    assert abs(found.flash.spread - SHOOT.flash_jitter) < 3 * found.flash.spread_sigma
    assert found.flash.pops == SHOOT.pops
    assert abs(found.flash.drift_per_pop) < 4 * found.flash.drift_sigma


def test_the_command_prints_every_quantity(found):
    text = "\n".join(calibrate_command.lines(found))
    for word in ("ISO 100", "levels     black 51", "falloff    corners", "polarizer  zero +1.", "from pop to pop"):
        assert word in text


def test_command_writes_a_dated_file_where_process_looks(folder, found, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path / "calib"))
    monkeypatch.setattr(calibrate, "measure", lambda *_: found)
    calibrate_command.calibrate(folder, json=True)
    answer = json.loads(capsys.readouterr().out)
    assert Path(answer["file"]).parent == tmp_path / "calib"
    assert calibrations.read(Path(answer["file"])).camera == found.camera
    assert answer["calibration"]["polarizer"]["zero_deg"] == found.polarizer.zero_deg


def test_example_runs(run_example, tmp_path):
    printed = run_example("calibrate_set_up.py", tmp_path)
    assert "zero of the ring 2.5" in printed or "zero of the ring 2.4" in printed
    assert list(tmp_path.glob("*.toml"))


def polarizer_only(tmp_path: Path, **changes) -> Path:
    small = {"width": 96, "height": 64, "isos": (), "pops": 0, "axes_deg": (0.0,), "ring_step_deg": 30.0}
    calibration_frames.write(tmp_path / "frames", CalibrationShoot(**{**small, **changes}))
    return tmp_path / "frames"


def test_light_of_one_axis_does_not_show_the_sense(tmp_path):
    ring = calibrate.measure(polarizer_only(tmp_path, zero_deg=-2.0), MADE).polarizer
    assert (ring.sense, ring.sense_known) == (1, False)
    assert ring.zero_deg == pytest.approx(-2.0, abs=0.2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extinction": (1.1, 1.1, 1.1)}, "hardly changes with the ring"),
        ({"ring_step_deg": 60.0}, r"3 angles of the ring over 120°; take 5"),
    ],
)
def test_unsuitable_polarizer_photographs_are_one_clear_line(tmp_path, changes, message):
    place = polarizer_only(tmp_path, **changes)
    with pytest.raises(CaptureError, match=message):
        calibrate.measure(place, MADE)


def test_empty_folders_are_one_clear_line(tmp_path):
    with pytest.raises(CaptureError, match="no such folder"):
        calibrate.measure(tmp_path / "none", MADE)
    with pytest.raises(CaptureError, match="none of the folders dark, flat, bracket, flash, lens, polarizer"):
        calibrate.measure(tmp_path, MADE)
    (tmp_path / "flat").mkdir()
    with pytest.raises(CaptureError, match="holds no RAW photograph"):
        calibrate.measure(tmp_path, MADE)


@pytest.mark.parametrize(("name", "angle"), [("pol045", 45.0), ("pol022.5", 22.5), ("polar", None), ("axis030", None)])
def test_angles_are_read_from_folder_names(name, angle):
    assert calibration_photographs.angle_of(name, "pol") == angle


def write_flat(path: Path, light: float, iso: float = 100.0, time: float = 0.01, model: str = "Synthetic") -> None:
    """One flat RAW of 64 × 64 px at `light` of white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sensor = SHOOT.sensor
    random = np.random.default_rng(len(list(path.parent.iterdir())))
    mosaic = forward_camera.expose(np.full((64, 64), light), sensor, 1.0, random)
    exif = Exif(make="Polcap", model=model, exposure_time=time, f_number=8.0, iso=iso)
    write_raw(path, mosaic, exif, sensor.black, sensor.white)


@pytest.mark.parametrize(
    ("message", "photographs"),
    [
        ("cap on", {"dark/a": (0.5, {})}),
        ("take each twice", {"flat/a": (0.2, {}), "flat/b": (0.4, {"time": 0.02})}),
        ("all of one brightness", {f"flat/{name}": (0.4, {}) for name in "ab"}),
        (
            "all of one brightness|clipped or dark",
            {f"flat/{name}": (0.001, {}) for name in "ab"} | {f"flat/{name}": (2.0, {"time": 1.0}) for name in "cd"},
        ),
        ("3 frames of one setting; take 4", {f"flash/{name}": (0.4, {}) for name in "abc"}),
        ("over-exposed", {f"flash/{name}": (2.0, {}) for name in "abcd"}),
        (
            "unequal exposure",
            {f"polarizer/pol{ring:03d}/a": (0.3, {"time": 0.01 + 0.001 * ring}) for ring in range(0, 180, 30)},
        ),
        ("one set-up at a time", {"dark/a": (0.0, {}), "dark/b": (0.0, {"model": "Other"})}),
        ("holds no pol000", {"polarizer/left/a": (0.3, {})}),
    ],
)
def test_bad_photographs_are_one_clear_line(tmp_path, message, photographs):
    for name, (light, changes) in photographs.items():
        write_flat(tmp_path / f"{name}.dng", light, **changes)
    with pytest.raises(CaptureError, match=message):
        calibrate.measure(tmp_path, MADE)


def test_a_damaged_photograph_is_named(tmp_path):
    file = tmp_path / "dark" / "a.dng"
    write_flat(file, 0.0)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"a\.dng"):
        calibrate.measure(tmp_path, MADE)
