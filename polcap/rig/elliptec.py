"""In: degrees. Out: a Thorlabs Elliptec rotation mount (ELL14, ELL18) that stands there.

ELLx protocol, 9600 8N1: the device's bus address, two letters, upper-case hexadecimal data; answers end in CR LF.
::

    0in            0IN type(2) serial(8) year(4) firmware(2) thread(2) travel(4) pulses per revolution(8)
    0gs            0GSnn                  status; reading it clears a fault
    0ho0 0ho1      0PO… when home, clockwise or counter-clockwise
    0ma… 0mr…      0PO… when there, absolute or relative, 32-bit two's complement; 0GS09 while busy
    0gp            0POxxxxxxxx
    0go 0so…       0HO… | 0GS00           home offset, kept in the device by 0us
    0sv..          0GS00                  speed [%]
"""

import re
import time
from typing import Annotated, Literal

from msgspec import Meta, Struct

from polcap.errors import HardwareError
from polcap.rig import serial_port
from polcap.rig.log import Log
from polcap.rig.serial_port import Port, Silent, patiently, started

BACKLASH_DEG = 0.0  # the piezo drives the ring itself
BAUD = 9600
STATUS = {
    0x01: "the bus timed out; check the cable",
    0x02: "the motor could not move: mechanical timeout; free the ring, check its power",
    0x03: "the command is not supported; update the device's firmware",
    0x04: "the value is out of range; home the device",
    0x05: "the device is isolated; switch it off and on",
    0x06: "the device is out of isolation; switch it off and on",
    0x07: "initialising failed; switch the device off and on",
    0x08: "the motor is too hot; let it cool",
    0x09: "busy",
    0x0A: "the position sensor fails; switch the device off and on",
    0x0B: "the motor fails; switch the device off and on",
    0x0C: "the position is out of range; home the device",
    0x0D: "over-current; free the ring, check the supply",
}
_OK, _BUSY = 0x00, 0x09
_LATE = 3  # answers to earlier commands that may still come when one is given
_FULL_SPEED = 430.0  # degrees/s, nominal
_ANSWER = re.compile(r"([0-9A-F])(IN|GS|PO|HO)([0-9A-F]+)")
_LENGTH = {"IN": 30, "GS": 2, "PO": 8, "HO": 8}  # digits of data


class Settings(Struct, frozen=True):
    """Of the rotator's URL."""

    address: Annotated[str, Meta(pattern="^[0-9A-Fa-f]$")] = "0"  # on the bus
    home: Literal["cw", "ccw"] = "cw"  # sense of the search for zero
    velocity: Annotated[int, Meta(ge=25, le=100)] | None = None  # percent of full speed
    zero: Annotated[float, Meta(ge=0, lt=360)] | None = None  # degrees; home offset to keep in the device


class Elliptec:
    """One rotation mount on a bus."""

    wraps = True

    def __init__(self, port: Port, settings: Settings, limit_s: float) -> None:
        self._port = port
        self._settings = settings
        self._address = settings.address.upper()
        self._limit_s = limit_s
        self.model = "Elliptec"
        patiently(lambda: self._ask("gs", "GS"))  # clears a fault of the day before
        reply = patiently(lambda: self._ask("in", "IN"))
        self.model = f"Elliptec ELL{int(reply[0:2], 16)}"
        self._pulses = int(reply[22:30], 16)  # per revolution
        if int(reply[18:22], 16) != 360 or self._pulses < 360:
            raise HardwareError(f"{self.model} at {port.url} is no rotation mount; give another port or address")
        self.speed_deg_s = _FULL_SPEED * (settings.velocity or 100) / 100
        if settings.velocity is not None:
            self._set(f"sv{settings.velocity:02X}")
        if settings.zero is not None:
            self._keep_zero(self._data(settings.zero))

    def home(self) -> None:
        self._move("ho0" if self._settings.home == "cw" else "ho1")

    def go(self, angle_deg: float) -> None:
        if 0.0 <= angle_deg < 360.0:
            self._move("ma" + self._data(angle_deg))
        else:  # absolute positions end at one revolution
            turn = (angle_deg - self.where() + 180.0) % 360.0 - 180.0
            self._move("mr" + self._data(turn))

    def where(self) -> float:
        pulses = int(self._ask("gp", "PO"), 16)
        return (pulses - (1 << 32 if pulses >> 31 else 0)) / self._pulses * 360.0

    def halt(self) -> None:
        self._port.send(f"{self._address}st".encode())  # between moves the piezo is without current
        for _ in range(_LATE):  # busy: the answer to a question asked before
            kind, data = self._answer()
            if (kind, int(data, 16)) != ("GS", _BUSY):
                return

    def close(self) -> None:
        self._port.close()

    def _move(self, command: str) -> None:
        """Send a movement and wait for its end: a position, or status ok where that answer was lost."""
        self._port.send(f"{self._address}{command}".encode())
        end = time.monotonic() + self._limit_s
        asked = False
        while time.monotonic() < end:
            try:
                kind, data = self._answer()
            except Silent:
                if asked:
                    raise
                self._port.send(f"{self._address}gs".encode())
                asked = True
                continue
            asked = False
            if kind == "PO" or (kind == "GS" and int(data, 16) == _OK):
                return
            if kind != "GS":
                raise self._port.strange(kind + data)
            if int(data, 16) != _BUSY:
                raise self._fault(int(data, 16))
        raise HardwareError(
            f"{self.model} on {self._port.url} is busy for more than timeout = {self._limit_s:g} s; "
            "free the ring, switch the device off and on"
        )

    def _set(self, command: str) -> None:
        status = int(patiently(lambda: self._ask(command, "GS")), 16)
        if status != _OK:
            raise self._fault(status)

    def _keep_zero(self, data: str) -> None:
        if patiently(lambda: self._ask("go", "HO")) != data:
            self._set("so" + data)
            self._set("us")

    def _ask(self, command: str, expected: str) -> str:
        """The data of the answer; a busy device is asked again. Raises Silent, HardwareError."""
        end = time.monotonic() + self._limit_s
        while True:
            self._port.send(f"{self._address}{command}".encode())
            if (data := self._reply(expected)) is not None:
                return data
            if time.monotonic() >= end:
                raise self._fault(_BUSY)

    def _reply(self, expected: str) -> str | None:
        """The data of the answer, None from a busy device; late answers to what was asked before are passed over."""
        busy = False
        for _ in range(_LATE + 1):
            try:
                kind, data = self._answer()
            except Silent:
                if busy:
                    return None
                raise
            busy = (kind, int(data, 16)) == ("GS", _BUSY)
            if kind == expected and not busy:
                return data
            if kind == "GS" and int(data, 16) not in (_OK, _BUSY):
                raise self._fault(int(data, 16))
        raise self._port.strange(kind + data)

    def _answer(self) -> tuple[str, str]:
        """Kind and data of this device's next answer; other addresses of the bus are passed over."""
        end = time.monotonic() + serial_port.ANSWER_S
        while True:
            line = self._port.read_line(max(0.0, end - time.monotonic()))
            match = _ANSWER.fullmatch(line)
            if match is None or len(match[3]) != _LENGTH[match[2]]:
                raise self._port.strange(line)
            if match[1] == self._address:
                return match[2], match[3]

    def _fault(self, status: int) -> HardwareError:
        text = STATUS.get(status, f"unknown status {status:02X}; switch the device off and on")
        return HardwareError(f"{self.model} on {self._port.url}: {text}")

    def _data(self, angle_deg: float) -> str:
        return f"{round(angle_deg / 360.0 * self._pulses) & 0xFFFFFFFF:08X}"


def recognize(line: str) -> str | None:
    """The name of what sent this line, if it was an Elliptec telling what it is."""
    match = _ANSWER.fullmatch(line)
    return f"Elliptec ELL{int(match[3][:2], 16)} at address {match[1]}" if match and match[2] == "IN" else None


def open_motor(port: str, settings: Settings, limit_s: float, log: Log) -> Elliptec:
    """Raises HardwareError where no Elliptec answers."""
    return started(lambda opened: Elliptec(opened, settings, limit_s), port, BAUD, log)
