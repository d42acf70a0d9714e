"""Complete RAW files are taken from a tethering folder, once each, and stay unchanged."""

from pathlib import Path

import pytest

from polcap.errors import HardwareError, SettingError
from polcap.rig import camera_watch_folder
from polcap.rig.camera_watch_folder import WatchFolderCamera
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_camera
from polcap.rig.exposure_bracket import Exposure
from tests.clocks import SleepClock
from tests.rig.pool import tiny

ANY = Exposure()


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> SleepClock:
    clock = SleepClock()
    monkeypatch.setattr(camera_watch_folder, "time", clock)
    return clock


@pytest.fixture
def tether(tmp_path: Path) -> Path:
    folder = tmp_path / "tether"
    folder.mkdir()
    tiny(folder / "yesterday.dng")
    return folder


def watched(folder: Path, timeout_s: float = 20.0) -> WatchFolderCamera:
    return WatchFolderCamera(str(folder), Log(None), timeout_s=timeout_s, stable_s=0.2)


def test_a_file_written_slowly_is_taken_when_complete_and_is_not_changed(
    tether: Path, tmp_path: Path, clock: SleepClock
) -> None:
    camera, data = watched(tether), tiny(tmp_path / "new.dng", iso=200.0)
    parts = iter([data[start : start + 400] for start in range(0, len(data), 400)])

    def write() -> None:
        with (tether / "IMG_1.dng").open("ab") as file:
            file.write(next(parts, b""))

    clock.meanwhile = write
    camera.prepare(0.0, "shot", 0)
    shot = camera.shoot(ANY, flash=True)
    assert shot.data == data == (tether / "IMG_1.dng").read_bytes() and shot.name == "IMG_1.dng"


def test_polcap_waits_for_a_file_when_its_writing_pauses(tether: Path, tmp_path: Path) -> None:
    """Half a DNG resembles a TIFF picture, or a RAW with data beyond its end."""
    camera, data = watched(tether, timeout_s=1.5), tiny(tmp_path / "new.dng", iso=200.0)
    camera.prepare(0.0, "shot", 0)
    for part in (100, 1200):
        (tether / "IMG_1.dng").write_bytes(data[:part])
        with pytest.raises(HardwareError, match="no new RAW"):
            camera.shoot(ANY, flash=True)
    (tether / "IMG_1.dng").write_bytes(data)
    assert camera.shoot(ANY, flash=True).data == data


def test_a_bracket_that_arrives_at_once_is_taken_in_order_each_file_once(tether: Path) -> None:
    camera = watched(tether)
    camera.prepare(0.0, "shot", 0)
    made = [tiny(tether / f"IMG_{number}.dng", iso=100.0 * number) for number in (1, 2, 3)]
    (tether / "IMG_1.jpg").write_bytes(b"\xff\xd8\xff a picture")
    (tether / "notes.txt").write_text("mine")
    assert [camera.shoot(ANY, flash=True).data for _ in range(3)] == made
    assert len(list(tether.iterdir())) == 6


def test_a_frame_from_before_the_turn_is_not_taken_for_the_next_angle(tether: Path) -> None:
    camera = watched(tether, timeout_s=0.6)
    camera.prepare(0.0, "shot", 0)
    tiny(tether / "early.dng", iso=400.0)
    camera.prepare(45.0, "shot", 0)
    with pytest.raises(HardwareError, match=r"no new RAW file in .* within 0.6 s"):
        camera.shoot(ANY, flash=True)


def test_a_file_that_cannot_be_decoded_is_named(tether: Path) -> None:
    camera = watched(tether, timeout_s=1.5)
    (tether / "IMG_2.CR3").write_bytes(b"\0\0\0\x18ftypcrx " + bytes(500))
    with pytest.raises(HardwareError, match=r"IMG_2.CR3"):
        camera.shoot(ANY, flash=True)


def test_a_missing_folder_bracket_or_disk_is_one_error(tether: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="no such folder"):
        open_camera(f"folder:{tmp_path / 'none'}", Log(None))
    camera = watched(tether)
    with pytest.raises(SettingError, match="--bracket"):
        camera.bracket(flash=False)
    (tether / "yesterday.dng").unlink()
    tether.rmdir()
    with pytest.raises(HardwareError, match="still there"):
        camera.shoot(ANY, flash=True)
