"""The simulated rig takes the photographs that the synthetic camera would."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from polcap.errors import SettingError
from polcap.formats.raw import libraw, probe
from polcap.rig import sequence
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_camera, open_rotator
from polcap.rig.exposure_bracket import Exposure, parse_bracket
from polcap.rig.motor_simulated import RING, SimulatedMotor, SimulatedMotorSettings
from polcap.rig.shooting_plan import CaptureOrder
from polcap.synth import shooting as synthetic
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import Shoot

SMALL = "width=96&height=72&samples=1"


def test_a_simulated_capture_is_the_synthetic_one_at_the_motors_true_angles(tmp_path: Path) -> None:
    order = CaptureOrder((0.0, 45.0, 90.0), (), rotator="simulated?seed=3&settle=0", camera=f"simulated?{SMALL}&seed=5")
    sequence.shoot(tmp_path / "rig", order)
    motor = SimulatedMotor(SimulatedMotorSettings(seed=3), Log(None))
    true = []
    for angle in order.angles_deg:
        motor.go(angle)
        assert RING.true_deg is not None and 0 < abs(RING.true_deg - angle) < 0.3
        true.append(RING.true_deg)
    motor.halt()
    shoot = Shoot(seed=5, width=96, height=72, samples=1, angles_deg=tuple(true))
    shoot = replace(shoot, nudge_px=0, nudge_deg=0, angle_error_deg=0)
    synthetic.write(tmp_path / "synth", random_scene(5, "bumps"), shoot)
    made = sorted((tmp_path / "synth").rglob("*.DNG"))
    shot = sorted((tmp_path / "rig").glob("pol*/*.dng"))
    assert len(made) == len(shot) == 9
    for theirs, ours in zip(made, shot):
        assert theirs.read_bytes() == ours.read_bytes(), ours


def test_backlash_appears_after_downward_movements_only() -> None:
    motor = SimulatedMotor(SimulatedMotorSettings(error=0.0, play=0.7), Log(None))
    motor.go(90.0)
    motor.go(30.0)
    assert RING.true_deg == pytest.approx(30.7)
    motor.halt()
    rotator = open_rotator("simulated?error=0&play=0.7&settle=0", Log(None))
    for angle in (90.0, 30.0):
        assert rotator.move(angle) == pytest.approx(angle)
        assert RING.true_deg == pytest.approx(angle)
    rotator.close()


def test_a_frame_taken_again_has_noise_of_its_own_and_every_role_too() -> None:
    camera = open_camera(f"simulated?{SMALL}", Log(None))
    seen = set()
    for role in ("shot", "shot", "repeat", "ambient", "chart"):
        camera.prepare(45.0, role, 1)
        seen.add(camera.shoot(Exposure(time_s=0.02), flash=role != "ambient").data)
    assert len(seen) == 5


@pytest.mark.parametrize(
    ("query", "words"),
    [("widht=96", "widht"), ("width=95", "multiple"), ("scene=teapot", "scene"), ("bracket=iso", "only time")],
)
def test_an_unknown_setting_of_the_simulated_camera_is_named(query: str, words: str) -> None:
    with pytest.raises(SettingError, match=rf"--camera simulated\?.*{words}"):
        open_camera(f"simulated?{query}", Log(None))


@pytest.mark.parametrize(
    "bracket",
    ["1/200,1/50,1/13", "iso100,iso400,iso1600", "f/22,f/11,f/5.6", "1/160 f/11 iso100 flash1/64, flash1/16, flash1/4"],
)
def test_the_simulated_camera_takes_the_brackets_of_the_documentation(bracket: str, tmp_path: Path) -> None:
    camera = open_camera(f"simulated?{SMALL}&gain_jitter=0", Log(None))
    light = []
    for step, exposure in enumerate(parse_bracket(bracket)):
        camera.prepare(0.0, "shot", step)
        taken = camera.shoot(exposure, flash=True)
        file = tmp_path / f"{step}.dng"
        file.write_bytes(taken.data)
        image = libraw.read(file)
        light.append((image.value - float(np.mean(image.black))) / (image.white - float(np.mean(image.black))))
        exif = probe.read(file).exif
        assert (exif.iso, exif.f_number) == (exposure.iso or 100, exposure.f_number or 11)
        assert exif.flash_fired is (not bracket.endswith("1/13"))
    sound = (light[2] > 0.2) & (light[2] < 0.9)  # above the noise, not clipped
    first, middle, last = (float(frame[sound].sum()) for frame in light)
    assert middle / first == pytest.approx(4, rel=0.06) and last / middle == pytest.approx(4, rel=0.06)


def test_an_unknown_camera_is_named() -> None:
    with pytest.raises(SettingError, match="--camera webcam: no such camera"):
        open_camera("webcam", Log(None))
