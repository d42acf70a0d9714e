"""GRBL 1.1 over the wire: scaling, homing, alarms, and a stop that loses no position."""

from typing import Any

import pytest

from polcap.errors import HardwareError
from polcap.rig import person
from polcap.rig.device_log import Log
from polcap.rig.motor_grbl import MEANING, GrblMotor, GrblSettings
from polcap.rig.serial_port import NoAnswer, Port
from tests.clocks import SleepClock
from tests.rig.devices import Grbl

pytestmark = [pytest.mark.timeout(60), pytest.mark.usefixtures("clock")]


def motor(device: Grbl, limit_s: float = 2.0, **settings: Any) -> GrblMotor:
    port = Port(device.port, GrblMotor.baud, Log(None))
    return GrblMotor(port, GrblSettings(timeout=limit_s, **settings))


def test_the_unit_of_grbl_is_a_degree() -> None:
    with Grbl(speed_deg_s=720) as device:
        board = motor(device)
        assert (board.model, board.speed_deg_s) == ("GRBL 1.1h", 720)
        board.home()
        board.go(45)
        assert "G21G90G53G0X-454.0000" in device.heard  # homing ends at -499
        assert (device.angle_deg, board.position()) == pytest.approx((45, 45))


def test_steps_state_the_motor_steps_of_a_degree() -> None:
    with Grbl(steps=80, degrees=4.5, speed_deg_s=900) as device:  # 80 steps/unit, so 17.78 steps a degree
        board = motor(device, steps=80 / 4.5)
        board.home()
        board.go(90)
        assert (device.angle_deg, board.position()) == pytest.approx((90, 90))
        assert board.speed_deg_s == pytest.approx(900)


def test_without_a_switch_the_error_names_both_remedies() -> None:
    words = r"error:5: homing is off; wire a switch and set \$22=1, or add home=ask"
    with Grbl(homing=False) as device, pytest.raises(HardwareError, match=words):
        motor(device).home()


def test_a_person_puts_the_ring_to_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    with Grbl(homing=False, start_deg=10) as device:
        monkeypatch.setattr(person, "ask", lambda question, log: asked.append(question))
        board = motor(device, home="ask")
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(55)
        assert board.position() == pytest.approx(45)
    assert asked == ["turn the polarizer's ring to 0°, then press Enter: "]


@pytest.mark.parametrize(
    ("fault", "words"),
    [("alarm", "ALARM:1: a limit switch was hit; free the ring"), ("restart", "restarted and lost its position")],
)
def test_an_alarm_or_a_restart_is_explained_and_ended_by_homing(fault: str, words: str) -> None:
    with Grbl(fault=fault, at=2) as device:
        board = motor(device)
        board.home()
        with pytest.raises(HardwareError, match=words):
            board.go(45)
        with pytest.raises(HardwareError, match="locked by an alarm"):
            board.position()
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(45)


def test_a_stop_holds_before_it_resets_and_the_motor_sleeps(clock: SleepClock) -> None:
    with Grbl(speed_deg_s=45) as device:
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
    with Grbl(speed_deg_s=10) as device:  # four seconds, in which GRBL is silent
        motor(device, limit_s=20).home()
        assert device.angle_deg == 0


@pytest.mark.parametrize("at", [1, 2])
def test_a_movement_without_end_ends_with_the_limit(at: int) -> None:
    with Grbl(fault="busy", at=at) as device:
        board = motor(device, limit_s=2.0)
        with pytest.raises(HardwareError, match=r"takes more than timeout = 2 s for (\$H|G4P0.01)"):
            board.home()
            board.go(45)


@pytest.mark.parametrize(
    ("banner", "error"), [("Grbl 0.9j ['$' for help]", NoAnswer), ("GrblHAL 1.1f ['$' or '$HELP' for help]", None)]
)
def test_only_version_1_1_is_accepted(banner: str, error: type[Exception] | None) -> None:
    with Grbl() as device:
        device.BANNER = banner
        if error:
            with pytest.raises(error, match=r"no GRBL 1\.1"):
                motor(device)
        else:
            assert motor(device).model == "GRBL 1.1f"


@pytest.mark.parametrize("inches", [False, True])
@pytest.mark.parametrize("mask", [0, 1, 2, 3, 511])
def test_settings_that_change_the_meaning_of_a_position_are_read(mask: int, inches: bool) -> None:
    with Grbl(mask=mask, inches=inches, degrees=4.5, steps=80, speed_deg_s=900, start_deg=33) as device:
        board = motor(device, steps=80 / 4.5)
        board.home()
        for angle in (45, 90):
            board.go(angle)
            assert board.position() == pytest.approx(angle, abs=0.02)
            assert device.angle_deg == pytest.approx(angle, abs=0.02)
        board.home()  # a reset: the offset is asked again
        assert board.position() == pytest.approx(0, abs=0.02)


def test_work_positions_without_their_offset_are_refused() -> None:
    class Work(Grbl):
        def report(self) -> None:
            self.say("<Idle|WPos:0.000,0.000,0.000|FS:0,0>")

    with Work() as device, pytest.raises(HardwareError, match=r"set \$10=1"):
        motor(device).home()


def test_codes_have_the_meaning_of_grbl() -> None:
    words = {"ALARM:1": "limit switch", "ALARM:3": "reset during a movement", "ALARM:9": "no switch"}
    words |= {"error:5": "homing is off", "error:9": "locked"}
    assert all(word in MEANING[code] for code, word in words.items())
