"""Motor driver for home-made rotators: the line protocol of `examples/rotator_firmware` (Arduino, RP2040).

115200 8N1, lines of ASCII; the reference page on rotators has all of it.
::

    ?          polcap-rotator 1 NAME SPEED     degrees/s; also sent, with ` started` at the end, when the board starts
    home       ok 0.000                        when the switch is found
    zero       ok 0.000                        the present position becomes zero
    go 45.000  ok 45.010                       when it has stopped; until then `busy 12.300` twice a second
    where      ok 45.010
    stop       ok 12.300                       stopped and released; zero is forgotten
               error and the reason            instead of any ok
"""

import re
import time
from typing import Literal

from polcap.errors import HardwareError
from polcap.rig import person
from polcap.rig.rotator import Backlash, RotatorSettings
from polcap.rig.serial_port import NoAnswer, Port

_START_S = 3.0  # for a board that restarts when its port is opened
_ASK_S = 0.5  # between two questions meanwhile
_HELLO = re.compile(r"polcap-rotator 1 (\S+) (\d+(?:\.\d+)?)( started)?")
_POSITION = re.compile(r"(ok|busy) (-?\d{1,9}(?:\.\d+)?)")


class LineSettings(RotatorSettings, frozen=True):
    """Settings in the URL of a `line` rotator."""

    backlash: Backlash = 2.0
    home: Literal["switch", "ask"] = "switch"  # ask: a person turns the ring to zero


class LineMotor:
    """A board that speaks the line protocol."""

    baud = 115200
    wraps = False

    def __init__(self, port: Port, settings: LineSettings) -> None:
        self._port = port
        self._settings = settings
        name, speed = self._hello()
        self.model = f"polcap-rotator {name}"
        self.speed_deg_s = max(speed, 0.1)

    def home(self) -> None:
        if self._settings.home == "ask":
            person.ask(person.RING_TO_ZERO, self._port.log)
            self._command("zero")
        else:
            self._command("home")

    def go(self, angle_deg: float) -> None:
        self._command(f"go {angle_deg:.3f}")

    def position(self) -> float:
        return self._command("where")

    def halt(self) -> None:
        self._command("stop")

    def _hello(self) -> tuple[str, float]:
        """Name and speed [degrees/s]; a board that is starting is asked repeatedly."""
        end = time.monotonic() + _START_S
        self._port.send("?\n", discard=False)
        while (left := end - time.monotonic()) > 0:
            try:
                if match := _HELLO.fullmatch(self._port.read_line(min(left, _ASK_S))):
                    return match[1], float(match[2])
            except NoAnswer:
                self._port.send("?\n", discard=False)
        raise NoAnswer(
            f"no polcap-rotator answers on {self._port.url}; load examples/rotator_firmware, check the cable"
        )

    def _command(self, command: str) -> float:
        """Send, wait for the end, return the position."""
        self._port.send(f"{command}\n")
        end = time.monotonic() + self._settings.timeout
        while time.monotonic() < end:
            line = self._port.read_line()
            if line.startswith("error "):
                raise self._failed(f": {line[6:]}")
            if hello := _HELLO.fullmatch(line):
                if hello[3]:
                    raise self._failed(" restarted and lost its zero; check its supply")
                continue  # the answer to an earlier `?`
            match = _POSITION.fullmatch(line)
            if match is None:
                raise self._port.unknown_answer(line)
            if match[1] == "ok":
                return float(match[2])
        raise self._failed(
            f" is busy for more than timeout = {self._settings.timeout:g} s at `{command}`; "
            "free the ring, or raise timeout in the rotator's URL"
        )

    def _failed(self, text: str) -> HardwareError:
        return HardwareError(f"{self.model} on {self._port.url}{text}")


def recognize(line: str) -> str | None:
    """The board's name if it sent this line."""
    match = _HELLO.fullmatch(line)
    return match and f"polcap-rotator {match[1]}"
