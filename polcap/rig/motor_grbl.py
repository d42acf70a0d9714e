"""Motor driver for a stepper on a GRBL 1.1 board: homing, movements, alarms and error codes.

115200 8N1, lines ended by LF, answered `ok`, `error:N` or `ALARM:N`; `?`, `!` and reset (0x18) act at once.
GRBL's unit of length is one degree, unless the setting `steps` gives the steps per degree.

References
----------
gnea/grbl, doc/markdown/interface.md
"""

import re
import time
from math import inf
from typing import Annotated, Literal

from msgspec import Meta

from polcap.errors import HardwareError
from polcap.rig import person, serial_port
from polcap.rig.rotator import Backlash, RotatorSettings
from polcap.rig.serial_port import NoAnswer, Port

MEANING = {  # of the codes that polcap's commands can cause
    "ALARM:1": "a limit switch was hit; free the ring",
    "ALARM:2": "the target is beyond the axis' travel; set $20=0 or raise $130",
    "ALARM:3": "reset during a movement, the position is lost; home again",
    "ALARM:6": "homing was interrupted by a reset; home again",
    "ALARM:7": "homing was interrupted by the safety door; close it",
    "ALARM:8": "homing could not leave the switch; raise the pull-off $27",
    "ALARM:9": "homing found no switch; check its wiring, $23 and $24",
    "error:3": "the $ command is unknown; update to GRBL 1.1",
    "error:5": "homing is off; wire a switch and set $22=1, or add home=ask to the rotator's URL",
    "error:7": "its stored settings were unreadable and reset; set them again",
    "error:8": "it is not idle; wait, or reset it",
    "error:9": "it is locked by an alarm; home it",
    "error:10": "soft limits need homing; set $20=0 or $22=1",
    "error:12": "the step rate is too high; lower $110",
    "error:13": "the safety door is open",
    "error:15": "the target is beyond the axis' travel; raise $130",
}
_START_S = 2.5  # for a board that restarts when its port is opened
_HOLD_S = 2.0  # longest deceleration
_POLL_S = 0.1  # between two questions for its state
_RESET = "\x18"
_BANNER = re.compile(r"Grbl(?:HAL)? (1\.1\S*) .*")  # sent after a reset
_STORED = re.compile(r"\$(\d{1,9})=(\d{1,9}(?:\.\d+)?)(?: .*)?")  # a setting in the answer to $$
_XYZ = r"(-?\d{1,9}\.?\d*),(-?\d{1,9}\.?\d*),(-?\d{1,9}\.?\d*)"
_STATUS = re.compile(rf"<(\w+)(?::\d+)?\|([MW])Pos:{_XYZ}[|,>].*")
_OFFSET = re.compile(rf"\|WCO:{_XYZ}")  # work position = machine position - offset
_REPORT_INCHES = 13  # number of the setting; GRBL stores its other settings in mm
_MM_PER_INCH = 25.4
_OFFSET_EVERY = 40  # reports; GRBL 1.1 states the offset in the first one and in one of 30 at least


class GrblSettings(RotatorSettings, frozen=True):
    """Settings in the URL of a `grbl` rotator."""

    backlash: Backlash = 2.0
    axis: Literal["X", "Y", "Z"] = "X"
    steps: Annotated[float, Meta(gt=0)] | None = None  # motor (micro)steps per degree of the polarizer
    home: Literal["switch", "ask"] = "switch"  # ask: a person turns the ring to zero


class GrblMotor:
    """Driver of one axis of a GRBL board."""

    baud = 115200
    wraps = False

    def __init__(self, port: Port, settings: GrblSettings) -> None:
        self._port = port
        self._settings = settings
        self._axis = "XYZ".index(settings.axis)
        self._zero = 0.0  # machine position, units
        self._offset: float | None = None  # of work positions, units; None: not reported since the last reset
        self.model = f"GRBL {self._reset()}"
        matches = [match for line in self._command("$$") if (match := _STORED.fullmatch(line))]
        stored = {int(match[1]): float(match[2]) for match in matches}
        for key in (100 + self._axis, 110 + self._axis):  # steps per unit, units per minute
            if not stored.get(key, 0.0) > 0.0:
                raise NoAnswer(f"{self.model} on {port.url} stated no ${key} above 0; set it in GRBL, or try again")
        steps_per_unit, units_per_minute = stored[100 + self._axis], stored[110 + self._axis]
        self._reported_unit = _MM_PER_INCH if stored.get(_REPORT_INCHES) else 1.0  # units; GRBL's unit is the mm
        self._units_per_degree = 1.0 if settings.steps is None else settings.steps / steps_per_unit
        self.speed_deg_s = units_per_minute / 60.0 / self._units_per_degree

    def home(self) -> None:
        """Home the axis: reset the board, which ends an alarm; then search the switch or ask a person."""
        self._reset()
        if self._settings.home == "switch":
            self._wait_for_ok("$H", quiet_s=inf)  # GRBL reports no state while it homes
        else:
            self._command("$X")
            person.ask(person.RING_TO_ZERO, self._port.log)
        self._zero = self._machine_position()  # any number: -499 for a travel of 500

    def go(self, angle_deg: float) -> None:
        target = self._zero + angle_deg * self._units_per_degree
        # in mm, absolute, of the machine, at full speed
        self._command(f"G21G90G53G0{self._settings.axis}{target:.4f}")
        self._wait_for_ok("G4P0.01", quiet_s=1.5 * serial_port.ANSWER_S)  # a pause begins when the motor has stopped

    def position(self) -> float:
        return (self._machine_position() - self._zero) / self._units_per_degree

    def halt(self) -> None:
        """Stop the motor and switch its current off: feed hold, reset, sleep."""
        try:
            self._port.send("!")
            end = time.monotonic() + _HOLD_S
            while time.monotonic() < end and self._state()[0] in ("Run", "Jog"):
                time.sleep(_POLL_S)
        finally:
            self._reset()
            self._command("$SLP")

    def _reset(self) -> str:
        """Reset the board; returns its version. Raises NoAnswer where no GRBL answers."""
        self._offset = None
        self._port.send(_RESET)
        end = time.monotonic() + _START_S
        while (left := end - time.monotonic()) > 0:
            try:
                if match := _BANNER.fullmatch(self._port.read_line(left)):
                    return match[1]
            except NoAnswer:
                continue  # noise while the board starts
        raise NoAnswer(f"no GRBL 1.1 answers on {self._port.url}; check the cable, the power and the firmware")

    def _command(self, text: str) -> list[str]:
        """Send a line; returns the lines received before its ok. Raises NoAnswer, HardwareError."""
        self._port.send(f"{text}\n")
        answer: list[str] = []
        lines = self._port.read_lines()
        while not self._is_ok(line := next(lines)):
            answer.append(line)
        return answer

    def _wait_for_ok(self, text: str, quiet_s: float) -> None:
        """Send a line that GRBL answers when the motor has stopped, and wait for the answer.

        After a second of silence GRBL is asked for its state. After `quiet_s` of silence the connection is lost.

        Raises NoAnswer, HardwareError.
        """
        self._port.send(f"{text}\n")
        last = time.monotonic()  # time of the last line
        end = last + self._settings.timeout
        while time.monotonic() < end:
            try:
                line = self._port.read_line()
            except NoAnswer:
                if time.monotonic() > last + quiet_s:
                    raise
                self._port.send("?", discard=False)
                continue
            last = time.monotonic()
            status = _STATUS.fullmatch(line)
            if self._is_ok(line) or (status and status[1] == "Idle"):  # idle: the ok was lost
                return
            if status and status[1] in ("Hold", "Door", "Check", "Sleep"):
                raise self._failed(f"does not move: state {status[1]}; resume or reset it")
        raise self._too_slow(text)

    def _machine_position(self) -> float:
        """Position of the axis in machine units, read when the axis has stopped."""
        end = time.monotonic() + self._settings.timeout
        while time.monotonic() < end:
            state, position = self._state()
            if state == "Alarm":
                raise self._failed("is locked by an alarm; home it")
            if state not in ("Run", "Jog"):
                return position
            time.sleep(_POLL_S)
        raise self._too_slow("the last movement")

    def _state(self) -> tuple[str, float]:
        """State of the board (Idle, Run, Alarm…) and machine position [units] of the axis.

        With $10=0 GRBL reports the work position, and only in some reports its offset; with $13=1 both are in inches.
        """
        for _ in range(_OFFSET_EVERY):
            self._port.send("?")
            lines = self._port.read_lines()
            while (match := _STATUS.fullmatch(line := next(lines))) is None:
                self._is_ok(line)  # raises on errors
            position = float(match[3 + self._axis]) * self._reported_unit
            if offset := _OFFSET.search(line):
                self._offset = float(offset[1 + self._axis]) * self._reported_unit
            if match[2] == "M":
                return match[1], position
            if self._offset is not None:
                return match[1], position + self._offset
        raise self._failed("reports work positions without their offset (WCO); set $10=1")

    def _is_ok(self, line: str) -> bool:
        """Whether a received line ends a command; status reports and messages do not.

        Raises NoAnswer, HardwareError.
        """
        if re.fullmatch(r"(error|ALARM):\d+", line):
            raise self._failed(f"answers {line}: {MEANING.get(line, 'see the list of codes of GRBL')}")
        if _BANNER.fullmatch(line):
            raise self._failed("restarted and lost its position; check its supply")
        if line != "ok" and line[0] not in "<[$>":
            raise self._port.unknown_answer(line)
        return line == "ok"

    def _too_slow(self, text: str) -> HardwareError:
        limit = f"timeout = {self._settings.timeout:g} s"
        return self._failed(f"takes more than {limit} for {text}; free the ring, or raise timeout in the rotator's URL")

    def _failed(self, text: str) -> HardwareError:
        return HardwareError(f"{self.model} on {self._port.url} {text}")


def recognize(line: str) -> str | None:
    """Name of a GRBL board if this line is its greeting or a status report; else None."""
    if match := _BANNER.fullmatch(line):
        return f"GRBL {match[1]}"
    return "GRBL" if _STATUS.fullmatch(line) else None
