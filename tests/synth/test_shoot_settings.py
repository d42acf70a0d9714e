"""Impossible settings of a simulated capture are refused in one line; folder names state the angle."""

from pathlib import Path

import msgspec
import pytest

from polcap.config import fill
from polcap.errors import SettingError
from polcap.formats.capture import folder_names
from polcap.synth import scenes, shooting
from polcap.synth.calibration_frames import CalibrationShoot
from polcap.synth.shooting import Shoot

SHOOT = [
    "seed=-1", "height=2000000", "focal_mm=-5", "angles_deg=[]", "angles_deg=[-45,0,45]", "gain_jitter=-1",
    "nudge_px=1e6", "extinction_ratio=-1", "flash_extinction=0", "blur_px=-1", "blur_px=1e5", "distortion=[5,5]",
    "color_matrix=[1]", "sensor={full_well=0}",
]  # fmt: skip
CALIBRATION = ["sense=0", "ring_step_deg=0", "isos=[0]", "power=0", "extinction=[0,1,1]", "pops=-1"]


@pytest.mark.parametrize(
    ("kind", "text"), [*((Shoot, t) for t in SHOOT), *((CalibrationShoot, t) for t in CALIBRATION)]
)
def test_impossible_settings_are_refused_in_one_line(kind: type[msgspec.Struct], text: str) -> None:
    with pytest.raises(SettingError, match=text.partition("=")[0]) as raised:
        fill(kind, {}, [text])
    assert "\n" not in str(raised.value)


def test_folder_names_state_the_angle(tmp_path: Path) -> None:
    angles = (22.25, 67.5, 112.125)
    shoot = Shoot(width=64, height=64, samples=1, exposures=1, cross=True, angles_deg=angles)
    shooting.write(tmp_path / "capture", scenes.random_scene(0, "bumps"), shoot)
    names = sorted(path.name for path in (tmp_path / "capture").iterdir() if path.is_dir())
    assert names == ["cross022.25", "pol022.25", "pol067.5", "pol112.125"]
    assert [folder_names.degrees(angle) for angle in (0, 45.0, 359.9996)] == ["000", "045", "360"]
