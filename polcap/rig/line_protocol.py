"""In: degrees. Out: a home-made rotator that stands there, on the line protocol of `examples/rotator_firmware`.

115200 8N1, lines of ASCII; the reference page on rotators has it in full.
::

    ?          polcap-rotator 1 NAME SPEED     degrees/s; unasked, with ` started` behind, when the board starts
    home       ok 0.000                        once the switch is found
    zero       ok 0.000                        where it stands is zero
    go 45.000  ok 45.010                       once it stands; until then `busy 12.300` twice a second
    where      ok 45.010
    stop       ok 12.300                       halted and released; zero is forgotten
               error what is wrong             instead of any ok
"""

import math
import re
import time
from typing import Literal

from msgspec import Struct

from polcap.errors import HardwareError
from polcap.rig import manual
from polcap.rig.log import Log
from polcap.rig.serial_port import Port, Silent, started

BACKLASH_DEG = 2.0
BAUD = 115200
_START_S = 3.0  # a board that restarts when its port is opened
_HELLO = re.compile(r"polcap-rotator 1 (\S+) (\d+(?:\.\d+)?)( started)?")
_SAYS = re.compile(r"(ok|busy) (-?\d+(?:\.\d+)?)")


class Settings(Struct, frozen=True):
    """Of the rotator's URL."""

    home: Literal["switch", "ask"] = "switch"  # ask: a person puts the ring to zero


class Line:
    """A board that speaks the line protocol."""

    wraps = False

    def __init__(self, port: Port, settings: Settings, limit_s: float, log: Log) -> None:
        self._port = port
        self._settings = settings
        self._limit_s = limit_s
        self._log = log
        name, speed = self._hello()
        self.model = f"polcap-rotator {name}"
        self.speed_deg_s = max(speed, 0.1)

    def home(self) -> None:
        if self._settings.home == "ask":
            manual.ask("turn the polarizer's ring to 0°, then Enter: ", self._log)
            self._do("zero")
        else:
            self._do("home")

    def go(self, angle_deg: float) -> None:
        self._do(f"go {angle_deg:.3f}")

    def where(self) -> float:
        return self._do("where")

    def halt(self) -> None:
        self._do("stop")

    def close(self) -> None:
        self._port.close()

    def _hello(self) -> tuple[str, float]:
        end = time.monotonic() + _START_S
        self._port.add(b"?\n")
        while (left := end - time.monotonic()) > 0:
            try:
                if match := _HELLO.fullmatch(self._port.read_line(min(left, 0.5))):
                    return match[1], float(match[2])
            except Silent:
                self._port.add(b"?\n")
        raise Silent(f"no polcap-rotator answers on {self._port.url}; load examples/rotator_firmware, check the cable")

    def _do(self, command: str) -> float:
        """Send, wait for the end, return the position."""
        self._port.send(f"{command}\n".encode())
        end = time.monotonic() + self._limit_s
        while time.monotonic() < end:
            said = self._port.read_line()
            if said.startswith("error "):
                raise HardwareError(f"{self.model} on {self._port.url}: {said[6:]}")
            if hello := _HELLO.fullmatch(said):
                if not hello[3]:  # asked for earlier
                    continue
                raise HardwareError(f"{self.model} on {self._port.url} restarted and lost its zero; check its supply")
            match = _SAYS.fullmatch(said)
            if match is None or not math.isfinite(float(match[2])):
                raise self._port.strange(said)
            if match[1] == "ok":
                return float(match[2])
        raise HardwareError(
            f"{self.model} on {self._port.url} is busy for more than timeout = {self._limit_s:g} s at `{command}`; "
            "free the ring, or raise timeout in the rotator's URL"
        )


def recognize(line: str) -> str | None:
    """The name of what sent this line, if it was such a board."""
    match = _HELLO.fullmatch(line)
    return match and f"polcap-rotator {match[1]}"


def open_motor(port: str, settings: Settings, limit_s: float, log: Log) -> Line:
    """Raises HardwareError where no such board answers."""
    return started(lambda opened: Line(opened, settings, limit_s, log), port, BAUD, log)
