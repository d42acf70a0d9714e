"""Motor driver for home-made rotators: the line protocol of `examples/rotator_firmware` (Arduino, RP2040).

115200 8N1, lines of ASCII; docs/reference/rotators.md has the whole protocol.
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
from contextlib import suppress
from typing import Literal

from polcap.errors import HardwareError
from polcap.rig import person
from polcap.rig.rotator import Backlash, RotatorSettings
from polcap.rig.serial_port import NoAnswer, Port

_START_S = 3.0  # for a board that restarts when its port is opened
_ASK_S = 0.5  # between two questions while it starts
_HELLO = re.compile(r"polcap-rotator 1 (\S+) (\d+(?:\.\d+)?)( started)?")
_POSITION = re.compile(r"(ok|busy) (-?\d{1,9}(?:\.\d+)?)")


class LineSettings(RotatorSettings, frozen=True):
    """Settings in the URL of a `line` rotator."""

    backlash: Backlash = 2.0
    home: Literal["switch", "ask"] = "switch"  # ask: a person turns the ring to zero


class LineMotor:
    """Driver of a board that speaks polcap's line protocol."""

    baud = 115200
    wraps = False

    def __init__(self, port: Port, settings: LineSettings) -> None:
        self._port = port
        self._settings = settings
        name, speed = self._greet()
        self.model = f"polcap-rotator {name}"
        self.speed_deg_s = max(speed, 0.1)  # never 0: times are estimated with it

    def home(self) -> None:
        if self._settings.home == "ask":
            person.ask(person.RING_TO_ZERO, self._port.log)
        self._command("zero" if self._settings.home == "ask" else "home")

    def go(self, angle_deg: float) -> None:
        self._command(f"go {angle_deg:.3f}")

    def position(self) -> float:
        return self._command("where")

    def halt(self) -> None:
        self._command("stop")

    def _greet(self) -> tuple[str, float]:
        """Name and speed [degrees/s] of the board; a board that is starting is asked repeatedly."""
        end = time.monotonic() + _START_S
        while time.monotonic() < end:
            self._port.send("?\n", discard=False)
            with suppress(NoAnswer):
                if match := _HELLO.fullmatch(self._port.read_line(_ASK_S)):
                    return match[1], float(match[2])
        raise NoAnswer(
            f"no polcap-rotator answers on {self._port.url}; load examples/rotator_firmware, check the cable"
        )

    def _command(self, command: str) -> float:
        """Send a command, wait for its end, return the position [degrees]."""
        self._port.send(f"{command}\n")
        end = time.monotonic() + self._settings.timeout
        while time.monotonic() < end:
            line = self._port.read_line()
            hello, position = _HELLO.fullmatch(line), _POSITION.fullmatch(line)
            if line.startswith("error "):
                raise self._failed(f": {line[6:]}")
            if hello and hello[3]:
                raise self._failed(" restarted and lost its zero; check its supply")
            if not hello and not position:  # a hello answers an earlier `?`
                raise self._port.unknown_answer(line)
            if position and position[1] == "ok":
                return float(position[2])
        raise self._failed(
            f" is busy for more than timeout = {self._settings.timeout:g} s at `{command}`; "
            "free the ring, or raise timeout in the rotator's URL"
        )

    def _failed(self, text: str) -> HardwareError:
        return HardwareError(f"{self.model} on {self._port.url}{text}")


def recognize(line: str) -> str | None:
    """Name of a line-protocol board if this line is its greeting; else None."""
    match = _HELLO.fullmatch(line)
    return match and f"polcap-rotator {match[1]}"
