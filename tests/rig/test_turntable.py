"""A session of views: the table turns before each, a stopped session goes on where it stopped."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from polcap.errors import CaptureError, HardwareError, SettingError
from polcap.formats.capture import reader as captures
from polcap.rig import device_urls, turntable
from polcap.rig.device_log import Log
from polcap.rig.turntable import SessionFile
from tests.rig import pool as pools
from tests.rig.pool import Key, PoolCamera
from tests.rig.test_motor_by_hand import typed
from tests.rig.test_sequence import Turner

ORDER = msgspec.structs.replace(pools.ORDER, rotator="simulated", repeat_deg=(), ambient=False)


class Table:
    """Ring, table and camera of a session; the camera fails in one of the views."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, pool: dict[Key, bytes]) -> None:
        self.pool, self.fails_in, self.opened = pool, 0, 0
        self.table = Turner()
        monkeypatch.setattr("polcap.rig.device_urls.open_camera", self.camera)
        monkeypatch.setattr("polcap.rig.device_urls.open_rotator", self.rotator)

    def camera(self, name: str, log: Log) -> PoolCamera:
        self.opened += 1
        broken = self.opened == self.fails_in
        return PoolCamera(self.pool, fault="disconnect", at=5) if broken else PoolCamera(self.pool)

    def rotator(self, url: str, log: Log, part: str = "polarizer") -> Turner:
        return self.table if "table" in part else Turner()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch, pool: dict[Key, bytes]) -> Table:
    return Table(monkeypatch, pool)


def started(folder: Path, **options: Any) -> SessionFile:
    session = turntable.open_session(folder, **{"views": 4, "turntable": "simulated", "resume": False, **options})
    assert session is not None
    return session


def test_each_view_is_a_capture_at_its_own_angle_of_the_table(rig: Table, tmp_path: Path) -> None:
    finished: list[str] = []
    folder = tmp_path / "vase"
    done = turntable.shoot(folder, started(folder), ORDER, finished=lambda view: finished.append(view.name))
    names = ["view01", "view02", "view03", "view04"]
    assert rig.table.moves == [0.0, 90.0, 180.0, 270.0] and rig.table.closed
    assert finished == names and [one["frames"] for one in done] == [9] * 4
    assert [len(captures.read(folder / name).shots) for name in names] == [3] * 4
    assert json.loads((folder / "views.json").read_text())["done"] == names


def test_a_stopped_session_continues_within_the_view_that_was_begun(rig: Table, tmp_path: Path) -> None:
    folder = tmp_path / "vase"
    rig.fails_in = 2
    with pytest.raises(HardwareError, match="--resume continues"):
        turntable.shoot(folder, started(folder), ORDER)
    with pytest.raises(CaptureError, match="not empty"):
        started(folder)
    with pytest.raises(CaptureError, match="begun with --views 4"):
        started(folder, views=6, resume=True)
    rig.table = Turner()
    session = started(folder, views=None, turntable=None, resume=True)
    done = turntable.shoot(folder, session, ORDER)
    assert rig.table.moves == [90.0, 180.0, 270.0]
    assert 0 < done[0]["taken"] < 9 and done[1]["taken"] == 9  # the begun view lacked some frames only


def test_views_and_turntable_belong_together(tmp_path: Path) -> None:
    for views, table in ((12, None), (None, "manual")):
        with pytest.raises(SettingError, match="belong together"):
            turntable.open_session(tmp_path / "new", views, table, False)
    assert turntable.open_session(tmp_path / "new", None, None, False) is None


def test_two_motors_on_one_port_are_refused(tmp_path: Path) -> None:
    order = msgspec.structs.replace(ORDER, rotator="elliptec:/dev/ttyUSB0?address=1")
    with pytest.raises(SettingError, match="both on /dev/ttyUSB0"):
        turntable.shoot(tmp_path / "vase", SessionFile(4, "elliptec:/dev/ttyUSB0"), order)


def test_a_person_is_asked_to_turn_the_board(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    typed(monkeypatch, "\n")
    assert device_urls.open_rotator("manual", Log(None), "turntable with the board").move(30) == 30
    assert "turn the turntable with the board to 30°" in capsys.readouterr().err
