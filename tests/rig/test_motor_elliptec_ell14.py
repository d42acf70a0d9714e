"""The bytes on the wire are those of the ELLx protocol, from the manual's examples and its arithmetic."""

from typing import Any

import pytest

from polcap.errors import HardwareError
from polcap.rig.device_log import Log
from polcap.rig.motor_elliptec_ell14 import STATUS, ElliptecMotor, ElliptecSettings
from polcap.rig.serial_port import NoAnswer, Port
from tests.rig.devices import Elliptec

pytestmark = [pytest.mark.timeout(60), pytest.mark.usefixtures("clock")]


def motor(device: Elliptec, limit_s: float = 2.0, **settings: Any) -> ElliptecMotor:
    port = Port(device.port, ElliptecMotor.baud, Log(None))
    return ElliptecMotor(port, ElliptecSettings(timeout=limit_s, **settings))


def test_degrees_become_pulses_in_eight_upper_case_digits() -> None:
    with Elliptec() as device:
        ell = motor(device)
        ell.home()
        for angle in (0.0, 45.0, 90.0, 359.999):
            ell.go(angle)
        # 143360 pulses a turn: 45° is 17920 = 0x4600, 90° is 35840 = 0x8C00
        assert device.heard == ["0gs", "0in", "0ho0", "0ma00000000", "0ma00004600", "0ma00008C00", "0ma00023000"]
        ell.home()
        ell.go(-2.0)
        assert device.heard[-1] == "0mrFFFFFCE4"  # -796 pulses: below zero is a relative movement
        assert ell.position() == pytest.approx(-2.0, abs=0.01) and ell.model == "Elliptec ELL14"


def test_pulses_per_revolution_are_read_from_the_device() -> None:
    class Coarse(Elliptec):
        PULSES = 36000

    with Coarse(kind=18) as device:
        ell = motor(device)
        ell.home()
        ell.go(45)
        assert device.heard[-1] == "0ma00001194"  # 4500
        assert ell.position() == pytest.approx(45.03)  # 3 pulses away
        assert ell.model == "Elliptec ELL18"


def test_only_the_own_address_is_asked_and_heard() -> None:
    class Chatty(Elliptec):
        def reply(self, text: str) -> None:
            self.say("3GS00")  # a neighbor on the bus
            super().reply(text)

    with Chatty(address="B") as device:
        motor(device, address="b", home="ccw").home()
        assert device.heard == ["Bgs", "Bin", "Bho1"]
    with Elliptec(address="B") as far, pytest.raises(NoAnswer, match="answered '0gs' with nothing"):
        motor(far)


def test_a_linear_stage_is_refused() -> None:
    words = r"ELL20 at .* is no rotation mount"
    with Elliptec(kind=20, travel=60) as device, pytest.raises(HardwareError, match=words):
        motor(device)


def test_an_old_fault_is_cleared() -> None:
    with Elliptec() as device:
        device._fault = 2
        motor(device).home()


@pytest.mark.parametrize("status", [code for code in STATUS if code != 9])
def test_every_status_has_a_message_and_ends_the_movement(status: int) -> None:
    class Failing(Elliptec):
        def halfway(self) -> None:
            self.status(status)

    with Failing(fault="mechanical-timeout", at=2) as device:
        ell = motor(device)
        ell.home()
        with pytest.raises(HardwareError) as raised:
            ell.go(45)
        assert STATUS[status] in str(raised.value)


def test_status_numbers_are_those_of_the_protocol() -> None:
    words = {0x02: "mechanical timeout", 0x04: "out of range", 0x08: "hot", 0x09: "busy", 0x0D: "over-current"}
    assert all(word in STATUS[code] for code, word in words.items())


def test_a_device_that_stays_busy_is_an_error_after_the_timeout() -> None:
    with Elliptec(fault="busy", at=2) as device:
        ell = motor(device)
        ell.home()
        with pytest.raises(HardwareError, match=r"busy for more than timeout = 2 s"):
            ell.go(45)
        assert "0gs" in device.heard[3:]
        ell.halt()
        assert device.heard[-1] == "0st" and not device.moving


def test_a_movement_longer_than_one_answer_is_waited_for() -> None:
    with Elliptec(speed_deg_s=15, start_deg=0.0) as device:  # three seconds for 45°
        ell = motor(device, limit_s=10)
        ell.go(45)
        assert ell.position() == pytest.approx(45, abs=0.02)


def test_velocity_is_set_and_slows_the_plan() -> None:
    with Elliptec() as device:
        full, slow = motor(device), motor(device, velocity=60)
        assert device.heard[-1] == "0sv3C"
        assert slow.speed_deg_s == pytest.approx(0.6 * full.speed_deg_s)


def test_zero_is_saved_in_the_device_only_if_it_is_new() -> None:
    with Elliptec() as device:
        motor(device, zero=45.0)
        assert device.heard[2:] == ["0go", "0so00004600", "0us"]
        assert device.saved_offset == 17920
        motor(device, zero=45.0)
        assert device.heard[5:] == ["0gs", "0in", "0go"]
