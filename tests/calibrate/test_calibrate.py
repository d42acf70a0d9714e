"""What `polcap calibrate` measures on photographs of a known set-up is that set-up, within the doubt it states."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from polcap import calibrate
from polcap.calibrate import calibration_photographs
from polcap.cli import calibrate_command
from polcap.errors import CaptureError, InputError
from polcap.formats import calibrations
from polcap.formats.raw import dng
from polcap.images import Calibration, Exif
from polcap.synth import calibration_frames, forward_camera
from polcap.synth.calibration_frames import CalibrationShoot

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


def test_noise_is_as_doubtful_as_it_says(found):
    pull = []
    for line in found.noise:
        slope = np.array([1, 0.5, 1]) * line.iso / 100 / SHOOT.sensor.full_well  # a green pixel is two photosites
        pull += list((np.array(line.slope) - slope) / np.array(line.slope_sigma))
    assert np.abs(pull).max() < 4
    assert 0.2 < np.std(pull) < 2.5


def test_black_that_is_not_the_stated_one_shows(found):
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


def test_what_is_measured_is_said(found):
    text = "\n".join(calibrate_command.lines(found))
    for word in ("ISO 100", "levels     black 51", "falloff    corners", "polarizer  zero +1.", "from pop to pop"):
        assert word in text


def test_command_writes_a_dated_file_where_process_looks(folder, found, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path / "calib"))
    monkeypatch.setattr(calibrate, "measure", lambda *_: found)
    calibrate_command.calibrate(None, folder, json=True)
    answer = json.loads(capsys.readouterr().out)
    assert Path(answer["file"]).parent == tmp_path / "calib"
    assert calibrations.read(Path(answer["file"])).camera == found.camera
    assert answer["calibration"]["polarizer"]["zero_deg"] == found.polarizer.zero_deg


def test_example_runs(tmp_path):
    script = Path(__file__).parents[2] / "examples" / "calibrate_set_up.py"
    done = subprocess.run([sys.executable, script, tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "zero of the ring 2.5" in done.stdout or "zero of the ring 2.4" in done.stdout
    assert list(tmp_path.glob("*.toml"))


def polarizer_only(tmp_path: Path, **changes) -> Path:
    small = {"width": 96, "height": 64, "isos": (), "pops": 0, "axes_deg": (0.0,), "ring_step_deg": 30.0}
    calibration_frames.write(tmp_path / "frames", CalibrationShoot(**{**small, **changes}))
    return tmp_path / "frames"


def test_one_axis_of_light_leaves_the_sense_open(tmp_path):
    ring = calibrate.measure(polarizer_only(tmp_path, zero_deg=-2.0), MADE).polarizer
    assert (ring.sense, ring.sense_known) == (1, False)
    assert ring.zero_deg == pytest.approx(-2.0, abs=0.2)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"extinction": (1.1, 1.1, 1.1)}, "hardly changes with the ring"),
        ({"ring_step_deg": 60.0}, r"3 angles of the ring; take 5"),
    ],
)
def test_photographs_that_do_not_tell_are_one_clear_line(tmp_path, changes, says):
    place = polarizer_only(tmp_path, **changes)
    with pytest.raises(CaptureError, match=says):
        calibrate.measure(place, MADE)


def test_folders_that_hold_nothing_are_one_clear_line(tmp_path):
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


def written(place: Path, light: float, iso: float = 100.0, time: float = 0.01, model: str = "Synthetic") -> None:
    """One flat RAW of 64 × 64 px at `light` of white."""
    place.parent.mkdir(parents=True, exist_ok=True)
    sensor = SHOOT.sensor
    random = np.random.default_rng(len(list(place.parent.iterdir())))
    mosaic = forward_camera.expose(np.full((64, 64), light), sensor, 1.0, random)
    exif = Exif(make="Polcap", model=model, exposure_time=time, f_number=8.0, iso=iso)
    dng.write(
        place, mosaic, cfa=np.array([[0, 1], [1, 2]], np.uint8), black=sensor.black, white=sensor.white, exif=exif,
        color_matrix=np.eye(3), as_shot_neutral=np.ones(3),
    )  # fmt: skip


def bad_dark(folder: Path) -> None:
    written(folder / "dark" / "a.dng", 0.5)


def single_flats(folder: Path) -> None:
    written(folder / "flat" / "a.dng", 0.2, time=0.01)
    written(folder / "flat" / "b.dng", 0.4, time=0.02)


def flats_alike(folder: Path) -> None:
    for name in "ab":
        written(folder / "flat" / f"{name}.dng", 0.4)


def burnt_flats(folder: Path) -> None:
    for name, light, time in (("a", 0.001, 0.01), ("b", 0.001, 0.01), ("c", 2.0, 1.0), ("d", 2.0, 1.0)):
        written(folder / "flat" / f"{name}.dng", light, time=time)


def few_pops(folder: Path) -> None:
    for name in "abc":
        written(folder / "flash" / f"{name}.dng", 0.4)


def burnt_pops(folder: Path) -> None:
    for name in "abcd":
        written(folder / "flash" / f"{name}.dng", 2.0)


def unlike_exposures(folder: Path) -> None:
    for ring in range(0, 180, 30):
        written(folder / "polarizer" / f"pol{ring:03d}" / "a.dng", 0.3, time=0.01 + 0.001 * ring)


def two_cameras(folder: Path) -> None:
    written(folder / "dark" / "a.dng", 0.0)
    written(folder / "dark" / "b.dng", 0.0, model="Other")


def no_angles(folder: Path) -> None:
    (folder / "polarizer" / "left").mkdir(parents=True)


def damaged(folder: Path) -> None:
    written(folder / "dark" / "a.dng", 0.0)
    whole = (folder / "dark" / "a.dng").read_bytes()
    (folder / "dark" / "a.dng").write_bytes(whole[: len(whole) // 2])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (bad_dark, "cap on"),
        (single_flats, "take each twice"),
        (flats_alike, "all of one brightness"),
        (burnt_flats, "all of one brightness|clipped or dark"),
        (few_pops, "3 frames of one setting; take 4"),
        (burnt_pops, "over-exposed"),
        (unlike_exposures, "unequal exposure"),
        (two_cameras, "one set-up at a time"),
        (no_angles, "holds no pol000"),
        (damaged, "a.dng"),
    ],
)
def test_bad_photographs_are_one_clear_line(tmp_path, make, says):
    make(tmp_path)
    with pytest.raises(InputError, match=says):
        calibrate.measure(tmp_path, MADE)
