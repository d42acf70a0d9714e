"""The bytes on the wire are those of the ELLx protocol, from the manual's examples and its arithmetic."""

from collections.abc import Iterator
from typing import Any

import pytest

from polcap.errors import HardwareError
from polcap.rig.device_log import Log
from polcap.rig.motor_elliptec_ell14 import STATUS, ElliptecMotor, ElliptecSettings
from polcap.rig.serial_port import NoAnswer, Port
from tests.rig import devices, virtual

pytestmark = pytest.mark.timeout(60)


@pytest.fixture(autouse=True)
def clock() -> Iterator[virtual.Clock]:
    with virtual.time() as clock:
        yield clock


@pytest.fixture
def device() -> Iterator[devices.Elliptec]:
    with devices.Elliptec() as device:
        yield device


def motor(device: devices.Elliptec, limit_s: float = 2.0, **settings: Any) -> ElliptecMotor:
    port = Port(device.port, ElliptecMotor.baud, Log(None))
    return ElliptecMotor(port, ElliptecSettings(timeout=limit_s, **settings))


def test_degrees_become_pulses_in_eight_upper_case_digits(device: devices.Elliptec) -> None:
    ell = motor(device)
    ell.home()
    for angle in (0.0, 45.0, 90.0, 359.999):
        ell.go(angle)
    # 143360 pulses a turn: 45° is 17920 = 0x4600, 90° is 35840 = 0x8C00
    assert device.heard == ["0gs", "0in", "0ho0", "0ma00000000", "0ma00004600", "0ma00008C00", "0ma00023000"]
    assert ell.model == "Elliptec ELL14"


def test_pulses_per_revolution_are_the_device_s() -> None:
    class Coarse(devices.Elliptec):
        PULSES = 36000

    with Coarse(kind=18) as device:
        ell = motor(device)
        ell.home()
        ell.go(45)
        assert device.heard[-1] == "0ma00001194"  # 4500
        assert ell.position() == pytest.approx(45.03)  # 3 pulses away
        assert ell.model == "Elliptec ELL18"


def test_below_zero_is_a_relative_move_in_two_s_complement(device: devices.Elliptec) -> None:
    ell = motor(device)
    ell.home()
    ell.go(-2.0)
    assert device.heard[-1] == "0mrFFFFFCE4"  # -796
    assert ell.position() == pytest.approx(-2.0, abs=0.01)


def test_only_its_own_address_is_asked_and_heard() -> None:
    class Chatty(devices.Elliptec):
        def reply(self, text: str) -> None:
            self.say("3GS00")  # a neighbour on the bus
            super().reply(text)

    with Chatty(address="B") as device:
        ell = motor(device, address="b", home="ccw")
        ell.home()
        assert device.heard == ["Bgs", "Bin", "Bho1"]
    with devices.Elliptec(address="B") as far, pytest.raises(NoAnswer, match="answered '0gs' with nothing"):
        motor(far)


def test_a_linear_stage_is_refused() -> None:
    with (
        devices.Elliptec(kind=20, travel=60) as device,
        pytest.raises(HardwareError, match=r"ELL20 at .* is no rotation mount"),
    ):
        motor(device)


def test_an_old_fault_is_cleared(device: devices.Elliptec) -> None:
    device._status = 2
    motor(device).home()


@pytest.mark.parametrize("status", [code for code in STATUS if code != 9])
def test_every_status_has_a_message_and_ends_the_move(status: int) -> None:
    class Failing(devices.Elliptec):
        def halfway(self) -> None:
            self.status(status)

    with Failing(fault="mechanical-timeout", at=2) as device:
        ell = motor(device)
        ell.home()
        with pytest.raises(HardwareError) as raised:
            ell.go(45)
        assert STATUS[status] in str(raised.value)


def test_the_protocol_s_status_numbers() -> None:
    assert "mechanical timeout" in STATUS[0x02]
    assert "out of range" in STATUS[0x04]
    assert "hot" in STATUS[0x08]
    assert STATUS[0x09] == "busy"
    assert "over-current" in STATUS[0x0D]


def test_busy_for_ever_ends_with_the_limit() -> None:
    with devices.Elliptec(fault="busy", at=2) as device:
        ell = motor(device, limit_s=2.0)
        ell.home()
        with pytest.raises(HardwareError, match=r"busy for more than timeout = 2 s"):
            ell.go(45)
        assert "0gs" in device.heard[3:]
        ell.halt()
        assert device.heard[-1] == "0st"
        assert not device.moving


def test_a_move_longer_than_one_answer_is_waited_for() -> None:
    with devices.Elliptec(speed_deg_s=15) as device:  # three seconds for 45°
        device.angle_deg = 0.0
        ell = motor(device, limit_s=10)
        ell.go(45)
        assert ell.position() == pytest.approx(45, abs=0.02)


def test_velocity_is_set_and_slows_the_plan(device: devices.Elliptec) -> None:
    ell = motor(device, velocity=60)
    assert device.heard[-1] == "0sv3C"
    assert ell.speed_deg_s == pytest.approx(0.6 * motor_speed())


def motor_speed() -> float:
    with devices.Elliptec() as device:
        return motor(device).speed_deg_s


def test_zero_is_saved_in_the_device_only_if_it_is_new(device: devices.Elliptec) -> None:
    motor(device, zero=45.0)
    assert device.heard[2:] == ["0go", "0so00004600", "0us"]
    assert device.saved_offset == 17920
    motor(device, zero=45.0)
    assert device.heard[5:] == ["0gs", "0in", "0go"]
