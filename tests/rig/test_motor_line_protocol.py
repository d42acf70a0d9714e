"""The line protocol of home-made rotators, over the wire."""

from typing import Any

import pytest

from polcap.errors import HardwareError
from polcap.rig import person
from polcap.rig.device_log import Log
from polcap.rig.motor_line_protocol import LineMotor, LineSettings
from polcap.rig.serial_port import NoAnswer, Port
from tests.rig import devices
from tests.rig.far_end import Device

pytestmark = [pytest.mark.timeout(120), pytest.mark.usefixtures("clock")]


def motor(device: Device, limit_s: float = 2.0, **settings: Any) -> LineMotor:
    port = Port(device.port, LineMotor.baud, Log(None))
    return LineMotor(port, LineSettings(timeout=limit_s, **settings))


def test_words_on_the_wire() -> None:
    with devices.Line() as device:
        board = motor(device)
        board.home()
        board.go(45)
        board.position()
        board.halt()
        assert device.heard == ["?", "home", "go 45.000", "where", "stop"]
        assert (board.model, board.speed_deg_s, device.released) == ("polcap-rotator simulated", 60, True)


def test_a_move_is_waited_for_as_long_as_it_is_busy() -> None:
    with devices.Line(speed_deg_s=10) as device:  # homing takes four seconds
        motor(device, limit_s=20).home()
        assert device.angle_deg == 0


def test_without_a_switch_the_error_names_the_way_out() -> None:
    with devices.Line(switch=False) as device, pytest.raises(HardwareError, match="there is no switch; use home=ask"):
        motor(device).home()


def test_a_person_puts_the_ring_to_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(person, "ask", lambda question, log: "")
    with devices.Line(switch=False, start_deg=10) as device:
        board = motor(device, home="ask")
        board.home()
        board.go(45)
        assert device.angle_deg == pytest.approx(55)


def test_after_a_stop_nothing_moves_before_homing() -> None:
    with devices.Line() as device:
        board = motor(device)
        board.home()
        board.halt()
        with pytest.raises(HardwareError, match="home first"):
            board.go(45)


def test_a_restart_during_a_move_is_an_error() -> None:
    with devices.Line(fault="restart", at=2) as device:
        board = motor(device)
        board.home()
        with pytest.raises(HardwareError, match="restarted and lost its zero"):
            board.go(45)


def test_another_device_is_not_taken_for_one() -> None:
    with devices.Grbl() as device, pytest.raises(NoAnswer, match="no polcap-rotator answers"):
        motor(device)
