"""In: an angle. Out: the same, or the one the person who turned the ring typed instead."""

import math
import sys

from polcap.errors import HardwareError, SettingError
from polcap.rig.log import Log


class Manual:
    """A person at the terminal turns the ring."""

    model = "by hand"
    speed_deg_s = 9.0  # a quarter turn in ten seconds, for the plan
    settle_s = 0.0
    unattended = False

    def __init__(self, log: Log) -> None:
        """Raises SettingError where nobody can be asked."""
        if sys.stdin is None or not sys.stdin.isatty():
            raise SettingError("rotator manual asks a person, and there is no terminal; run in one, or name a motor")
        self._log = log

    def home(self) -> None:
        """Nothing: the ring's own scale is the zero."""

    def move(self, angle_deg: float) -> float:
        text = ask(f"turn the polarizer to {angle_deg:g}°, then Enter; or type the angle it stands at: ", self._log)
        while True:
            if not text:
                return angle_deg % 360.0
            try:
                typed = float(text.removesuffix("°").replace(",", "."))
                if math.isfinite(typed):
                    return typed % 360.0
            except ValueError:
                pass
            text = ask(f"{text!r} is no angle; degrees, or Enter for {angle_deg:g}: ", self._log)

    def stop(self) -> None:
        """Nothing turns."""

    def close(self) -> None:
        """Nothing is held."""


def ask(question: str, log: Log) -> str:
    """A person's answer: asked on stderr, read from stdin.

    Raises
    ------
    HardwareError
        Nobody answers: the end of input.
    """
    print(question, end="", file=sys.stderr, flush=True)
    log.write("person", ">", question.strip())
    answer = sys.stdin.readline() if sys.stdin else ""
    if not answer:
        raise HardwareError("nobody turns the polarizer: the input has ended; run in a terminal")
    log.write("person", "<", answer.strip())
    return answer.strip()
