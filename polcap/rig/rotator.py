"""The rotator of the polarizer: a motor with zero offset, direction, one-sided approach and read-back."""

import time
from contextlib import suppress
from typing import Annotated, Protocol

from msgspec import Meta, Struct

from polcap.errors import HardwareError, PolcapError
from polcap.rig.device_log import Log
from polcap.rig.serial_port import NoAnswer, Port, Unplugged, retry

_APPROACHES = 2  # a wrong position is approached once more


class Motor(Protocol):
    """Protocol of a motor driver; angles are the motor's, in degrees."""

    model: str
    speed_deg_s: float
    wraps: bool  # positions are modulo 360

    def home(self) -> None:
        """Search the motor's zero position."""

    def go(self, angle_deg: float) -> None:
        """Turn the motor to an angle; returns when it has stopped."""

    def position(self) -> float:
        """The angle [degrees] that the motor reports."""

    def halt(self) -> None:
        """Stop the motor and switch its current off."""


Backlash = Annotated[float, Meta(ge=0, le=45)]  # degrees; downward movements go this far below the target, then up


class RotatorSettings(Struct, frozen=True):
    """Settings in the URL of every motor; a driver adds its own."""

    offset: float = 0.0  # degrees; the motor's position where the polarizer's axis is at 0°
    reverse: bool = False  # the motor's degrees run clockwise, as the photographer sees the picture
    backlash: Backlash = 0.0
    settle: Annotated[float, Meta(ge=0, le=60)] = 0.2  # s
    tolerance: Annotated[float, Meta(gt=0, le=45)] = 0.3  # degrees
    timeout: Annotated[float, Meta(gt=0, le=600)] = 30.0  # s; the longest movement


class PolarizerRotator:
    """The polarizer's rotator: turns the axis to an angle and returns the angle that the motor reports."""

    def __init__(
        self, motor: Motor, settings: RotatorSettings, log: Log, port: Port | None = None, by_hand: bool = False
    ) -> None:
        self.model = motor.model
        self.speed_deg_s = motor.speed_deg_s
        self.settle_s = settings.settle
        self.by_hand = by_hand
        self._motor = motor
        self._settings = settings
        self._log = log
        self._port = port
        self._homed = False
        self._stopped_at: float | None = None  # motor degrees, reached from below

    def home(self) -> None:
        self._stopped_at = None
        retry(self._motor.home)
        self._homed = True

    def move(self, angle_deg: float) -> float:
        """Turn the axis to an angle; returns the angle read back, in [0, 360).

        Raises HardwareError if the motor fails, or stops further from the angle than the tolerance.
        """
        if not self._homed or self._was_moved():
            self.home()
        sense = -1 if self._settings.reverse else 1
        target = self._settings.offset + sense * angle_deg
        if self._motor.wraps:
            target %= 360.0
        error = 0.0
        for _ in range(_APPROACHES):
            self._approach(target)
            time.sleep(self._settings.settle)
            error = self._distance(target)
            if abs(error) <= self._settings.tolerance:
                self._stopped_at = target
                return (angle_deg + sense * error) % 360.0 % 360.0  # twice: rounding may leave 360
        raise HardwareError(
            f"{self.model} is {error:+.2f}° away from {angle_deg:g}°, more than tolerance = "
            f"{self._settings.tolerance:g}°; free the ring, check the mount, or raise tolerance in the rotator's URL"
        )

    def close(self) -> None:
        """Stop and release the motor, and close its port; never raises."""
        self._homed = False  # a released ring may be turned by hand
        with suppress(PolcapError):
            self._motor.halt()
        if self._port is not None:
            self._port.close()

    def _was_moved(self) -> bool:
        """Whether the motor is no longer where it stopped, because it restarted, is locked, or was moved by hand."""
        if self._stopped_at is None:
            return False
        try:
            away = self._distance(self._stopped_at)
            if abs(away) <= self._settings.tolerance:
                return False
            reason = f"is {away:+.2f}° away from where it stopped"
        except (NoAnswer, Unplugged):
            raise
        except HardwareError as error:
            reason = str(error)
        self._log.write("rotator", "!", f"{reason}; homed again")
        return True

    def _approach(self, target: float) -> None:
        """Turn the motor to `target` degrees, always upwards at the end, so that gear backlash causes no error."""
        previous, self._stopped_at = self._stopped_at, None
        backlash = self._settings.backlash
        if backlash and (previous is None or target < previous):
            retry(lambda: self._motor.go(target - backlash))
        retry(lambda: self._motor.go(target))

    def _distance(self, target: float) -> float:
        """The motor's position relative to `target`, in [-180, 180) degrees."""
        return (retry(self._motor.position) - target + 180.0) % 360.0 - 180.0
