"""Complete RAW files are taken from a tethering folder, once each, and stay unchanged."""

import os
from pathlib import Path

import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.errors import HardwareError, SettingError
from polcap.rig import camera_watch_folder
from polcap.rig.camera_watch_folder import WatchFolderCamera
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_camera
from polcap.rig.exposure_bracket import Exposure
from tests.clocks import SleepClock
from tests.raw_files import write_raw
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


def large(path: Path, iso: float = 100.0) -> bytes:
    """A RAW of several blocks, uncompressed: without its end it decodes to zeros."""
    mosaic = np.random.default_rng(int(iso)).integers(600, 9000, (256, 256)).astype(np.uint16)
    return write_raw(path, mosaic, Exif(make="Tiny", model="One", exposure_time=0.02, f_number=11.0, iso=iso))


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


@pytest.mark.parametrize("stated_late", [False, True])
def test_a_file_of_final_size_is_taken_when_its_content_is_there(
    tether: Path, tmp_path: Path, clock: SleepClock, stated_late: bool
) -> None:
    """As Explorer, robocopy and SMB copy; a drive may state the time of the copy when it is closed."""
    camera, data, file = watched(tether), large(tmp_path / "new.dng"), tether / "IMG_1.dng"
    ends = iter([len(data) * part // 8 for part in range(8) for _ in range(4)])  # pauses longer than `stable_s`

    def write() -> None:
        content = data[: next(ends, len(data))].ljust(len(data), b"\0")
        if not file.exists() or file.read_bytes() != content:
            file.write_bytes(content)
        if stated_late:
            os.utime(file, (1e9, 1e9))

    clock.meanwhile = write
    camera.prepare(0.0, "shot", 0)
    assert camera.shoot(ANY, flash=True).data == data


def test_a_gap_in_the_middle_of_a_file_is_waited_for(tether: Path, tmp_path: Path) -> None:
    camera, data = watched(tether, timeout_s=2.0), large(tmp_path / "new.dng")
    camera.prepare(0.0, "shot", 0)
    half = len(data) // 2
    (tether / "IMG_1.dng").write_bytes(data[:half] + bytes(half // 2) + data[half + half // 2 :])
    with pytest.raises(HardwareError, match=r"IMG_1\.dng: a part of it is empty"):
        camera.shoot(ANY, flash=True)
    (tether / "IMG_1.dng").write_bytes(data)
    assert camera.shoot(ANY, flash=True).data == data


@pytest.mark.parametrize("renamed", [False, True])
def test_a_program_that_writes_every_photograph_under_one_name_loses_none(
    tether: Path, tmp_path: Path, renamed: bool
) -> None:
    camera, made = watched(tether), []
    for angle in (0.0, 45.0):
        camera.prepare(angle, "shot", 0)
        for iso in (100.0, 200.0, 400.0):
            made.append(tiny(tmp_path / "new.dng", iso=iso, f_number=1 + angle))
            if renamed:
                (tmp_path / "new.dng").rename(tether / "yesterday.dng")
            else:
                (tether / "yesterday.dng").write_bytes(made[-1])
            assert camera.shoot(ANY, flash=True).data == made[-1]


def test_a_photograph_whose_time_changes_is_taken_once(tether: Path) -> None:
    camera = watched(tether, timeout_s=2.0)
    camera.prepare(0.0, "shot", 0)
    data = tiny(tether / "IMG_1.dng", iso=400.0)
    assert camera.shoot(ANY, flash=True).data == data
    os.utime(tether / "IMG_1.dng", (1e9, 1e9))  # as a copying program does at its end
    with pytest.raises(HardwareError, match="no new RAW"):
        camera.shoot(ANY, flash=True)


def test_a_file_that_was_begun_before_the_turn_is_not_taken_after_it(
    tether: Path, tmp_path: Path, clock: SleepClock
) -> None:
    camera, data = watched(tether, timeout_s=3.0), tiny(tmp_path / "new.dng", iso=400.0)
    camera.prepare(0.0, "shot", 0)
    ends = iter(range(len(data) // 10, len(data), len(data) // 10))
    clock.meanwhile = lambda: (tether / "slow.dng").write_bytes(data[: next(ends, len(data))])
    clock.meanwhile()
    camera.prepare(45.0, "shot", 0)
    clock.meanwhile = lambda: None
    (tether / "slow.dng").write_bytes(data)
    os.utime(tether / "slow.dng", (1e9, 1e9))
    next_one = tiny(tether / "z.dng", iso=800.0)
    assert camera.shoot(ANY, flash=True).data == next_one


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
