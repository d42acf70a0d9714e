"""In: degrees. Out: a stepper behind GRBL 1.1 that stands there.

115200 8N1, lines ended by LF, answered `ok`, `error:N` or `ALARM:N`; `?`, `!` and reset (0x18) act at once.
GRBL's unit of length is taken as a degree, or the setting `steps` says how many steps one takes.

References
----------
gnea/grbl, doc/markdown/interface.md
"""

import re
import time
from contextlib import suppress
from math import inf
from typing import Annotated, Literal

from msgspec import Meta, Struct

from polcap.errors import HardwareError
from polcap.rig import manual, serial_port
from polcap.rig.log import Log
from polcap.rig.serial_port import Port, Silent, patiently, started

BACKLASH_DEG = 2.0
BAUD = 115200
ALARM = {
    1: "a limit switch was hit; free the ring",
    2: "the target lies beyond the axis' travel; set $20=0 or raise $130",
    3: "reset while moving, the position is lost; home again",
    4: "the probe was not in its expected state",
    5: "the probe found no contact",
    6: "homing was interrupted by a reset; home again",
    7: "homing was interrupted by the safety door; close it",
    8: "homing could not leave the switch; raise the pull-off $27",
    9: "homing found no switch; check its wiring, $23 and $24",
}
ERROR = {
    1: "a command letter was expected",
    2: "a number is malformed",
    3: "the $ command is unknown; update to GRBL 1.1",
    4: "a value is negative",
    5: "homing is off; wire a switch and set $22=1, or add home=ask to the rotator's URL",
    7: "its stored settings were unreadable and reset; set them again",
    8: "it is not idle; wait, or reset it",
    9: "it is locked by an alarm; home it",
    10: "soft limits need homing; set $20=0 or $22=1",
    11: "the line is too long",
    12: "the step rate is too high; lower $110",
    13: "the safety door is open",
    15: "the target lies beyond the axis' travel; raise $130",
    20: "the command is not supported",
    33: "the target is invalid",
}
_START_S = 2.5  # a board that restarts when its port is opened
_HOLD_S = 2.0  # to slow down in
_LOOK_S = 0.1  # between two questions for its state
_RESET = b"\x18"
_BANNER = re.compile(r"Grbl(?:HAL)? (1\.1\S*) .*")
_STORED = re.compile(r"\$(\d{1,9})=(\d{1,9}(?:\.\d+)?)(?: .*)?")
_STATUS = re.compile(r"<(\w+)(?::\d+)?\|MPos:(-?\d{1,9}\.?\d*),(-?\d{1,9}\.?\d*),(-?\d{1,9}\.?\d*).*>")


class Settings(Struct, frozen=True):
    """Of the rotator's URL."""

    axis: Literal["X", "Y", "Z"] = "X"
    steps: Annotated[float, Meta(gt=0)] | None = None  # motor (micro)steps per degree of the polarizer
    home: Literal["switch", "ask"] = "switch"  # ask: a person puts the ring to zero


class Grbl:
    """One axis of a GRBL board."""

    wraps = False

    def __init__(self, port: Port, settings: Settings, limit_s: float, log: Log) -> None:
        self._port = port
        self._settings = settings
        self._limit_s = limit_s
        self._log = log
        self._axis = "XYZ".index(settings.axis)
        self._zero = 0.0  # machine units
        self.model = f"GRBL {patiently(self._wake)}"
        stored = patiently(self._stored)
        self._per_degree = 1.0 if settings.steps is None else settings.steps / stored[100 + self._axis]
        self.speed_deg_s = stored[110 + self._axis] / 60.0 / self._per_degree

    def home(self) -> None:
        """Reset, then seek the switch or ask a person; ends an alarm."""
        self._wake()
        if self._settings.home == "switch":
            self._until_done("$H", silent_s=inf)  # no state while it homes
        else:
            self._command("$X")
            manual.ask("turn the polarizer's ring to 0°, then Enter: ", self._log)
        self._zero = self._position()  # the switch's may be any number: -499 for a travel of 500

    def go(self, angle_deg: float) -> None:
        target = self._zero + angle_deg * self._per_degree
        self._command(f"G21G90G53G0{self._settings.axis}{target:.4f}")
        self._until_done("G4P0.01", silent_s=1.5 * serial_port.ANSWER_S)  # a dwell waits for the movement

    def where(self) -> float:
        return (self._position() - self._zero) / self._per_degree

    def halt(self) -> None:
        """Feed hold, reset once it stands, sleep: the coils are without current."""
        try:
            self._port.send(b"!")
            end = time.monotonic() + _HOLD_S
            while time.monotonic() < end and self._status()[0] in ("Run", "Jog"):
                time.sleep(0.05)
        finally:
            self._wake()
            self._command("$SLP")

    def close(self) -> None:
        self._port.close()

    def _wake(self) -> str:
        """Reset; returns the version. Raises Silent where no GRBL answers."""
        self._port.send(_RESET)
        end = time.monotonic() + _START_S
        while (left := end - time.monotonic()) > 0:
            with suppress(Silent):
                if match := _BANNER.fullmatch(self._port.read_line(left)):
                    return match[1]
        raise Silent(f"no GRBL 1.1 answers on {self._port.url}; check the cable, the power and the firmware")

    def _stored(self) -> dict[int, float]:
        """The settings that $$ lists."""
        stored: dict[int, float] = {}
        for line in self._command("$$"):
            if match := _STORED.fullmatch(line):
                stored[int(match[1])] = float(match[2])
        for key in (100 + self._axis, 110 + self._axis):
            if not stored.get(key, 0.0) > 0.0:
                raise Silent(f"{self.model} on {self._port.url} did not state ${key}; set it in GRBL, or try again")
        return stored

    def _command(self, text: str) -> list[str]:
        """Send a line, return what came before its ok. Raises Silent, HardwareError."""
        self._port.send(f"{text}\n".encode())
        said: list[str] = []
        end = time.monotonic() + serial_port.ANSWER_S
        while True:
            line = self._port.read_line(max(0.0, end - time.monotonic()))
            if self._says_ok(line):
                return said
            said.append(line)

    def _until_done(self, text: str, silent_s: float) -> None:
        """Send a line whose ok comes once the ring stands, and wait for it.

        A board that is quiet for long is asked for its state; one that is for longer than `silent_s` is lost.

        Raises
        ------
        Silent, HardwareError
        """
        self._port.send(f"{text}\n".encode())
        heard = time.monotonic()
        end = heard + self._limit_s
        while time.monotonic() < end:
            try:
                line = self._port.read_line()
            except Silent:
                if time.monotonic() > heard + silent_s:
                    raise
                self._port.add(b"?")
                continue
            heard = time.monotonic()
            if self._says_ok(line):
                return
            status = _STATUS.fullmatch(line)
            if status and status[1] == "Idle":  # its ok was lost
                return
            if status and status[1] in ("Hold", "Door", "Check", "Sleep"):
                raise self._error(f"does not move: state {status[1]}; resume or reset it")
        raise self._error(
            f"takes more than timeout = {self._limit_s:g} s for {text}; free the ring, or raise timeout in the "
            "rotator's URL"
        )

    def _position(self) -> float:
        """Of the axis, in machine units, once it stands: the ok that ended a movement may have been an older one."""
        end = time.monotonic() + self._limit_s
        while time.monotonic() < end:
            state, at = self._status()
            if state == "Alarm":
                raise self._error("is locked by an alarm; home it")
            if state not in ("Run", "Jog"):
                return at
            time.sleep(_LOOK_S)
        raise self._error(f"still moves after timeout = {self._limit_s:g} s; raise timeout in the rotator's URL")

    def _status(self) -> tuple[str, float]:
        """State and machine position of the axis."""
        self._port.send(b"?")
        end = time.monotonic() + serial_port.ANSWER_S
        while True:
            line = self._port.read_line(max(0.0, end - time.monotonic()))
            if match := _STATUS.fullmatch(line):
                return match[1], float(match[2 + self._axis])
            if "|WPos:" in line:
                raise self._error("reports work positions; set $10=1")
            self._says_ok(line)

    def _says_ok(self, line: str) -> bool:
        """Whether a line ends a command well; reports and messages do not. Raises Silent, HardwareError."""
        if line == "ok":
            return True
        if match := re.fullmatch(r"(error|ALARM):(\d+)", line):
            words = (ERROR if match[1] == "error" else ALARM).get(int(match[2]), "see GRBL's list of codes")
            raise self._error(f"says {line}: {words}")
        if _BANNER.fullmatch(line):
            raise self._error("restarted and lost its position; check its supply")
        if line[0] not in "<[$>":
            raise self._port.strange(line)
        return False

    def _error(self, text: str) -> HardwareError:
        return HardwareError(f"{self.model} on {self._port.url} {text}")


def recognize(line: str) -> str | None:
    """The name of what sent this line, if it was GRBL."""
    if match := _BANNER.fullmatch(line):
        return f"GRBL {match[1]}"
    return "GRBL" if _STATUS.fullmatch(line) else None


def open_motor(port: str, settings: Settings, limit_s: float, log: Log) -> Grbl:
    """Raises HardwareError where no GRBL answers."""
    return started(lambda opened: Grbl(opened, settings, limit_s, log), port, BAUD, log)
