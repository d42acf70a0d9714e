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
from typing import Annotated, Literal

from msgspec import Meta, Struct

from polcap.errors import HardwareError
from polcap.rig import manual
from polcap.rig.log import Log
from polcap.rig.transport import Port, Silent

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
_START_S = 3.0  # a board that restarts when its port is opened
_HOLD_S = 2.0  # to slow down in
_QUIET_S = 1.0  # without a word while it moves: ask it
_RESET = b"\x18"
_BANNER = re.compile(r"Grbl(?:HAL)? (1\.1\S*) .*")
_STATUS = re.compile(r"<(\w+)(?::\d+)?\|MPos:(-?\d+\.?\d*),(-?\d+\.?\d*),(-?\d+\.?\d*).*>")


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
        self.model = f"GRBL {self._wake()}"
        stored = self._stored()
        self._per_degree = 1.0 if settings.steps is None else settings.steps / stored[100 + self._axis]
        self.speed_deg_s = stored[110 + self._axis] / 60.0 / self._per_degree

    def home(self) -> None:
        """Reset, then seek the switch or ask a person; ends an alarm."""
        self._wake()
        if self._settings.home == "switch":
            self._homed()
        else:
            self._command("$X")
            manual.ask("turn the polarizer's ring to 0°, then Enter: ", self._log)
        self._zero = self._position()  # the switch's may be any number: -499 for a travel of 500

    def go(self, angle_deg: float) -> None:
        target = self._zero + angle_deg * self._per_degree
        self._command(f"G21G90G53G0{self._settings.axis}{target:.4f}")
        self._finish()

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

    def _homed(self) -> None:
        """$H: no status while it runs."""
        self._port.send(b"$H\n")
        end = time.monotonic() + self._limit_s
        while (left := end - time.monotonic()) > 0:
            try:
                line = self._port.read_line(left)
            except Silent as error:
                if time.monotonic() < end:
                    raise
                raise self._busy("homing") from error
            if self._says_ok(line):
                return
        raise self._busy("homing")

    def _stored(self) -> dict[int, float]:
        """The settings that $$ lists."""
        stored: dict[int, float] = {}
        for line in self._command("$$"):
            number, _, value = line.removeprefix("$").partition("=")
            with suppress(ValueError):
                stored[int(number)] = float(value.split()[0])
        for key in (100 + self._axis, 110 + self._axis):
            if not stored.get(key, 0.0) > 0.0:
                raise HardwareError(f"{self.model} on {self._port.url} states no ${key}; set it in GRBL")
        return stored

    def _command(self, text: str) -> list[str]:
        """Send a line, return what came before its ok. Raises Silent, HardwareError."""
        self._port.send(f"{text}\n".encode())
        said: list[str] = []
        end = time.monotonic() + self._port.timeout_s
        while True:
            line = self._port.read_line(max(0.0, end - time.monotonic()))
            if self._says_ok(line):
                return said
            said.append(line)

    def _finish(self) -> None:
        """Wait until all movement has ended: a dwell is answered only then. Raises Silent, HardwareError."""
        self._port.send(b"G4P0.01\n")
        end = time.monotonic() + self._limit_s
        asked = False
        while (left := end - time.monotonic()) > 0:
            try:
                line = self._port.read_line(min(_QUIET_S, left))
            except Silent:
                if asked:
                    raise
                self._port.add(b"?")
                asked = True
                continue
            asked = False
            if self._says_ok(line):
                return
            status = _STATUS.fullmatch(line)
            if status and status[1] == "Idle":  # its ok was lost
                return
            if status and status[1] in ("Hold", "Door", "Check", "Sleep"):
                raise HardwareError(
                    f"{self.model} on {self._port.url} does not move: state {status[1]}; resume or reset it"
                )
        raise self._busy("a movement")

    def _position(self) -> float:
        state, at = self._status()
        if state == "Alarm":
            raise HardwareError(f"{self.model} on {self._port.url} is locked by an alarm; home it")
        return at

    def _status(self) -> tuple[str, float]:
        """State and machine position of the axis."""
        self._port.send(b"?")
        end = time.monotonic() + self._port.timeout_s
        while True:
            line = self._port.read_line(max(0.0, end - time.monotonic()))
            if match := _STATUS.fullmatch(line):
                return match[1], float(match[2 + self._axis])
            if "|WPos:" in line:
                raise HardwareError(f"{self.model} on {self._port.url} reports work positions; set $10=1")
            self._says_ok(line)

    def _says_ok(self, line: str) -> bool:
        """Whether a line ends a command well; reports and messages do not. Raises Silent, HardwareError."""
        where = f"{self.model} on {self._port.url}"
        if line == "ok":
            return True
        if match := re.fullmatch(r"(error|ALARM):(\d+)", line):
            words = (ERROR if match[1] == "error" else ALARM).get(int(match[2]), "see GRBL's list of codes")
            raise HardwareError(f"{where}: {line}, {words}")
        if _BANNER.fullmatch(line):
            raise HardwareError(f"{where} restarted and lost its position; check its supply, then --resume")
        if line[0] not in "<[$>":
            raise self._port.strange(line)
        return False

    def _busy(self, doing: str) -> HardwareError:
        return HardwareError(
            f"{self.model} on {self._port.url}: {doing} takes more than timeout = {self._limit_s:g} s; "
            "free the ring, or raise timeout in the rotator's URL"
        )


def recognize(line: str) -> str | None:
    """The name of what sent this line, if it was GRBL."""
    if match := _BANNER.fullmatch(line):
        return f"GRBL {match[1]}"
    return "GRBL" if _STATUS.fullmatch(line) else None


def open_motor(port: str, settings: Settings, limit_s: float, log: Log) -> Grbl:
    """Raises HardwareError where no GRBL answers."""
    opened = Port(port, baud=BAUD, log=log, name="rotator")
    try:
        return Grbl(opened, settings, limit_s, log)
    except BaseException:
        opened.close()
        raise
