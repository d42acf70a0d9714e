"""Motor driver for Thorlabs Elliptec rotation mounts ELL14 and ELL18: homing, movements, status codes.

ELLx protocol, 9600 8N1: the device's bus address, two letters, upper-case hexadecimal data; answers end in CR LF.
::

    0in            0IN type(2) serial(8) year(4) firmware(2) thread(2) travel(4) pulses per revolution(8)
    0gs            0GSnn                  status; reading it clears a fault
    0ho0 0ho1      0PO… when home, clockwise or counter-clockwise
    0ma… 0mr…      0PO… at the end, absolute or relative, 32-bit two's complement; 0GS09 while busy
    0gp            0POxxxxxxxx
    0go 0so…       0HO… | 0GS00           home offset; 0us saves it in the device
    0sv..          0GS00                  speed [%]
"""

import re
import time
from collections.abc import Iterator
from typing import Annotated, Literal

from msgspec import Meta

from polcap.errors import HardwareError
from polcap.rig.rotator import RotatorSettings
from polcap.rig.serial_port import NoAnswer, Port

STATUS = {
    0x01: "the bus timed out; check the cable",
    0x02: "the motor could not move: mechanical timeout; free the ring, check its power",
    0x03: "the command is not supported; update the device's firmware",
    0x04: "the value is out of range; home the device",
    0x05: "the device is isolated; switch it off and on",
    0x06: "the device is out of isolation; switch it off and on",
    0x07: "initializing failed; switch the device off and on",
    0x08: "the motor is too hot; let it cool",
    0x09: "busy",
    0x0A: "the position sensor failed; switch the device off and on",
    0x0B: "the motor failed; switch the device off and on",
    0x0C: "the position is out of range; home the device",
    0x0D: "over-current; free the ring, check the supply",
}
_OK, _BUSY = "00", "09"
_FULL_SPEED = 430.0  # degrees/s, nominal
_ANSWER = re.compile(r"([0-9A-F])(IN|GS|PO|HO)([0-9A-F]+)")
_DIGITS = {"IN": 30, "GS": 2, "PO": 8, "HO": 8}  # of an answer's data


class ElliptecSettings(RotatorSettings, frozen=True):
    """Settings in the URL of an `elliptec` rotator."""

    address: Annotated[str, Meta(pattern="^[0-9A-Fa-f]$")] = "0"  # on the bus
    home: Literal["cw", "ccw"] = "cw"  # sense of the search for zero
    velocity: Annotated[int, Meta(ge=25, le=100)] | None = None  # percent of full speed
    zero: Annotated[float, Meta(ge=0, lt=360)] | None = None  # degrees; home offset saved in the device


class ElliptecMotor:
    """Driver of one Elliptec rotation mount on a serial bus."""

    baud = 9600
    wraps = True

    def __init__(self, port: Port, settings: ElliptecSettings) -> None:
        self._port = port
        self._settings = settings
        self._address = settings.address.upper()
        self.model = "Elliptec"
        self._ask("gs", "GS")  # clears an old fault
        identity = self._ask("in", "IN")
        self.model = f"Elliptec ELL{int(identity[0:2], 16)}"
        self._pulses = int(identity[22:30], 16)  # per revolution
        if int(identity[18:22], 16) != 360 or self._pulses < 360:
            raise HardwareError(f"{self.model} at {port.url} is no rotation mount; give another port or address")
        self.speed_deg_s = _FULL_SPEED * (settings.velocity or 100) / 100
        if settings.velocity is not None:
            self._set(f"sv{settings.velocity:02X}")
        if settings.zero is not None:
            offset = self._hexadecimal(settings.zero)
            if self._ask("go", "HO") != offset:  # the device's memory wears
                self._set("so" + offset)
                self._set("us")

    def home(self) -> None:
        self._move("ho0" if self._settings.home == "cw" else "ho1")

    def go(self, angle_deg: float) -> None:
        if 0.0 <= angle_deg < 360.0:
            self._move("ma" + self._hexadecimal(angle_deg))
        else:  # absolute positions end at one revolution
            turn = (angle_deg - self.position() + 180.0) % 360.0 - 180.0
            self._move("mr" + self._hexadecimal(turn))

    def position(self) -> float:
        pulses = int(self._ask("gp", "PO"), 16)
        return (pulses - (1 << 32 if pulses >> 31 else 0)) / self._pulses * 360.0  # two's complement

    def halt(self) -> None:
        self._ask("st", "GS")  # without movement the piezo has no current

    def _move(self, command: str) -> None:
        """Send a movement command and wait for its end: the mount answers with its position, or with status ok."""
        end = time.monotonic() + self._settings.timeout
        self._port.send(self._address + command)
        while time.monotonic() < end:
            try:
                kind, data = next(self._answers())
            except NoAnswer:  # a moving device is silent, but answers questions
                self._port.send(f"{self._address}gs", discard=False)
                kind, data = next(self._answers())
            if kind == "PO" or (kind, data) == ("GS", _OK):
                return
            if kind != "GS":
                raise self._port.unknown_answer(kind + data)
            if data != _BUSY:
                raise self._fault(data)
        raise HardwareError(
            f"{self.model} on {self._port.url} is busy for more than timeout = {self._settings.timeout:g} s; "
            "free the ring, switch the device off and on"
        )

    def _ask(self, command: str, expected: str) -> str:
        """Send a command and return the data of its answer; a busy device is asked again.

        `expected` are the two letters of the answer. Raises NoAnswer, HardwareError.
        """
        end = time.monotonic() + self._settings.timeout
        while time.monotonic() < end:
            self._port.send(self._address + command)
            for kind, data in self._answers():  # those of an earlier command are skipped
                if (kind, data) == ("GS", _BUSY):
                    break
                if kind == expected:
                    return data
                if kind == "GS" and data != _OK:
                    raise self._fault(data)
        raise self._fault(_BUSY)

    def _set(self, command: str) -> None:
        if (status := self._ask(command, "GS")) != _OK:
            raise self._fault(status)

    def _answers(self) -> Iterator[tuple[str, str]]:
        """Yield kind and data of this device's answers; answers from other bus addresses are skipped.

        Raises NoAnswer.
        """
        for line in self._port.read_lines():
            match = _ANSWER.fullmatch(line)
            if match is None or len(match[3]) != _DIGITS[match[2]]:
                raise self._port.unknown_answer(line)
            if match[1] == self._address:
                yield match[2], match[3]

    def _fault(self, status: str) -> HardwareError:
        text = STATUS.get(int(status, 16), f"unknown status {status}; switch the device off and on")
        return HardwareError(f"{self.model} on {self._port.url}: {text}")

    def _hexadecimal(self, angle_deg: float) -> str:
        """Convert an angle to encoder pulses as a 32-bit hexadecimal number."""
        return f"{round(angle_deg / 360.0 * self._pulses) & 0xFFFFFFFF:08X}"


def recognize(line: str) -> str | None:
    """Name of an Elliptec mount if this line is its identity; else None."""
    match = _ANSWER.fullmatch(line)
    return f"Elliptec ELL{int(match[3][:2], 16)} at address {match[1]}" if match and match[2] == "IN" else None
