"""GRBL 1.1 over the wire: scaling, homing, alarms, and a stop that loses no position."""

from collections.abc import Iterator
from typing import Any

import pytest

from polcap.errors import HardwareError
from polcap.rig import person
from polcap.rig.device_log import Log
from polcap.rig.motor_grbl import MEANING, GrblMotor, GrblSettings
from polcap.rig.serial_port import NoAnswer, Port
from tests.rig import devices, virtual

pytestmark = pytest.mark.timeout(60)


@pytest.fixture(autouse=True)
def clock() -> Iterator[virtual.Clock]:
    with virtual.time() as clock:
        yield clock


def motor(device: devices.Grbl, limit_s: float = 2.0, **settings: Any) -> GrblMotor:
    port = Port(device.port, GrblMotor.baud, Log(None))
    return GrblMotor(port, GrblSettings(timeout=limit_s, **settings))


def test_grbl_s_unit_is_a_degree() -> None:
    with devices.Grbl(speed_deg_s=720) as device:
        board = motor(device)
        assert (board.model, board.speed_deg_s) == ("GRBL 1.1h", 720)
        board.home()
        board.go(45)
        assert "G21G90G53G0X-454.0000" in device.heard  # homing ends at -499
        assert (device.angle_deg, board.position()) == pytest.approx((45, 45))


def test_or_steps_say_how_much_of_a_unit_a_degree_is() -> None:
    with devices.Grbl(steps=80, degrees=4.5, speed_deg_s=900) as device:  # 80 steps/unit, so 17.78 steps a degree
        board = motor(device, steps=80 / 4.5)
        board.home()
        board.go(90)
        assert (device.angle_deg, board.position()) == pytest.approx((90, 90))
        assert board.speed_deg_s == pytest.approx(900)


def test_without_a_switch_the_error_names_both_ways_out() -> None:
    words = r"error:5: homing is off; wire a switch and set \$22=1, or add home=ask"
    with devices.Grbl(homing=False) as device, pytest.raises(HardwareError, match=words):
        motor(device).home()


def test_or_a_person_puts_the_ring_to_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    with devices.Grbl(homing=False, start_deg=10) as device:
        monkeypatch.setattr(person, "ask", lambda question, log: asked.append(question))
        board = motor(device, home="ask")
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(55)
        assert board.position() == pytest.approx(45)
    assert asked == ["turn the polarizer's ring to 0°, then press Enter: "]


def test_an_alarm_is_explained_and_ended_by_homing() -> None:
    with devices.Grbl(fault="alarm", at=2) as device:
        board = motor(device)
        board.home()
        with pytest.raises(HardwareError, match="ALARM:1: a limit switch was hit; free the ring"):
            board.go(45)
        with pytest.raises(HardwareError, match="locked by an alarm"):
            board.position()
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(45)


def test_a_restart_during_a_move_is_reported_and_ended_by_homing() -> None:
    with devices.Grbl(fault="restart", at=2) as device:
        board = motor(device)
        board.home()
        with pytest.raises(HardwareError, match="restarted and lost its position"):
            board.go(45)
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(45)


def test_a_stop_holds_before_it_resets_and_the_motor_sleeps(clock: virtual.Clock) -> None:
    with devices.Grbl(speed_deg_s=45) as device:
        device.angle_deg = 0.0
        board = motor(device)
        board.home()
        board._command("G21G90G53G0X-454.0")
        clock.sleep(0.1)
        board.halt()
        assert device.heard[-4:] == ["!", "?", "reset", "$SLP"]
        assert device.state == "Sleep"
        assert 0 < device.angle_deg < 45
        board.home()  # wakes it
        assert device.state == "Idle"


def test_homing_may_be_longer_than_one_answer() -> None:
    with devices.Grbl(speed_deg_s=10) as device:  # four seconds, in which GRBL is silent
        motor(device, limit_s=20).home()
        assert device.angle_deg == 0


@pytest.mark.parametrize("at", [1, 2])
def test_a_movement_without_end_ends_with_the_limit(at: int) -> None:
    with devices.Grbl(fault="busy", at=at) as device:
        board = motor(device, limit_s=2.0)
        with pytest.raises(HardwareError, match=r"takes more than timeout = 2 s for (\$H|G4P0.01)"):
            board.home()
            board.go(45)


@pytest.mark.parametrize(
    ("banner", "error"), [("Grbl 0.9j ['$' for help]", NoAnswer), ("GrblHAL 1.1f ['$' or '$HELP' for help]", None)]
)
def test_only_version_1_1_is_spoken(banner: str, error: type[Exception] | None) -> None:
    with devices.Grbl() as device:
        device.BANNER = banner
        if error:
            with pytest.raises(error, match=r"no GRBL 1\.1"):
                motor(device)
        else:
            assert motor(device).model == "GRBL 1.1f"


def test_work_positions_are_refused() -> None:
    class Work(devices.Grbl):
        def report(self) -> None:
            self.say("<Idle|WPos:0.000,0.000,0.000|FS:0,0>")

    with Work() as device, pytest.raises(HardwareError, match=r"set \$10=1"):
        motor(device).home()


def test_codes_have_grbl_s_meaning() -> None:
    assert "limit switch" in MEANING["ALARM:1"]
    assert "reset during a movement" in MEANING["ALARM:3"]
    assert "no switch" in MEANING["ALARM:9"]
    assert "homing is off" in MEANING["error:5"]
    assert "locked" in MEANING["error:9"]
