"""The camera driver with libgphoto2's own virtual camera: dials, RAW bytes, and failures."""

import threading
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from polcap.errors import HardwareError, SettingError
from polcap.rig import camera_gphoto2
from polcap.rig.camera_gphoto2 import CallTimeout, Gphoto2Camera
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_camera
from polcap.rig.exposure_bracket import Exposure
from tests.rig.pool import tiny, virtual_gphoto2

gphoto2 = pytest.importorskip("gphoto2")


@pytest.fixture
def card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The virtual camera's card: the camera photographs its file."""
    card = tmp_path / "card"
    card.mkdir()
    virtual_gphoto2(monkeypatch, card)
    tiny(card / "x.jpg")
    return card


@pytest.fixture
def camera(card: Path, tmp_path: Path) -> Iterator[Gphoto2Camera]:
    camera = Gphoto2Camera("", Log(tmp_path / "rig.log"), timeout_s=60.0)
    yield camera
    camera.close()


def test_raw_bytes_are_identical_and_dials_have_the_nearest_value_in_stops(
    camera: Gphoto2Camera, card: Path, tmp_path: Path
) -> None:
    shot = camera.shoot(Exposure(time_s=1 / 60, f_number=10.5, iso=100.0), flash=True)
    assert shot.data == (card / "x.jpg").read_bytes()
    assert shot.name.endswith(".JPG") and shot.suffix == ".dng"
    assert shot.exposure == Exposure(time_s=0.02, f_number=11.0)  # of 0.02 s and 0.01 s; the body has no ISO
    assert camera._value("shutterspeed") == "0.0200s" and camera._value("f-number") == "f/11"
    log = (tmp_path / "rig.log").read_text()
    assert "camera > shutterspeed = 0.0200s" in log and "camera > f-number = f/11" in log
    with pytest.raises(SettingError, match=r"time_s 0.4; .*0.1, 1"):
        camera.shoot(Exposure(time_s=0.4), flash=True)


def test_the_default_bracket_is_two_stops_around_the_shutter_time(camera: Gphoto2Camera) -> None:
    assert [exposure.time_s for exposure in camera.bracket(flash=False)] == [0.0025, 0.01, 0.04]
    with pytest.raises(SettingError, match=r"ISO cannot be set; .*: flash power or aperture"):  # the body has none
        camera.bracket(flash=True)
    assert not camera.switches_flash


def test_a_camera_that_fails_once_is_connected_again(camera: Gphoto2Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = camera._capture
    monkeypatch.setattr(camera, "_capture", mock.Mock(side_effect=[gphoto2.GPhoto2Error(-7), capture()]))
    assert camera.shoot(Exposure(), flash=True).data
    for code, words in ((-52, r"Nikon DSC D750: capture: .* \(-52\); plug it in"), (-115, "card is full")):
        monkeypatch.setattr(camera, "_capture", mock.Mock(side_effect=gphoto2.GPhoto2Error(code)))
        with pytest.raises(HardwareError, match=words):
            camera.shoot(Exposure(), flash=True)


def test_a_camera_that_hangs_is_an_error_in_time(card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Gphoto2Camera("D750", Log(None))
    monkeypatch.setattr(camera, "_timeout_s", 0.3)
    release = threading.Event()
    capture = mock.Mock(side_effect=lambda: release.wait(300))
    monkeypatch.setattr(camera, "_capture", capture)
    with pytest.raises(CallTimeout, match=r"capture took more than 0.3 s"):
        camera.shoot(Exposure(), flash=True)
    camera.close()  # returns, although the call hangs
    assert capture.call_count <= 1
    release.set()


@pytest.mark.parametrize("which", ["Leica", "usb:009,009"])
def test_an_absent_camera_is_an_error_that_lists_the_connected_ones(card: Path, which: str) -> None:
    with pytest.raises(HardwareError, match="Nikon DSC D750 at usb:001,001"):
        open_camera(f"gphoto2:{which}", Log(None))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1/200", 0.005), ("0.0050s", 0.005), ("f/11", 11.0), ("2,5", 2.5), ("30", 30.0), ("1/3.2 s", 1 / 3.2),
        ("Auto", None), ("bulb", None), ("0", None), ("implicit auto", None), ("", None),
    ],
)  # fmt: skip
def test_dials_are_read_in_every_makers_spelling(text: str, value: float | None) -> None:
    assert camera_gphoto2._number(text) == pytest.approx(value)
