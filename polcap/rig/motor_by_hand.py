"""Motor driver for `manual`: a person at the terminal turns polarizer or board and may type the angle reached."""

import math

from polcap.errors import SettingError
from polcap.rig import person
from polcap.rig.device_log import Log
from polcap.rig.rotator import RotatorSettings

SETTINGS = RotatorSettings(settle=0.0, tolerance=180.0)  # any angle typed is accepted


class MotorByHand:
    """Driver that asks a person to turn the ring or the board to each angle; a scale on it defines zero."""

    model = "by hand"
    speed_deg_s = 9.0  # a quarter turn in ten seconds, for the plan
    wraps = False

    def __init__(self, log: Log, part: str = "polarizer") -> None:
        """`part`: the part that the person turns. Raises SettingError without a terminal."""
        if not person.at_terminal():
            raise SettingError("rotator manual asks a person, and there is no terminal; run in one, or name a motor")
        self._log = log
        self._part = part
        self._angle_deg = 0.0

    def home(self) -> None: ...

    def go(self, angle_deg: float) -> None:
        question = f"turn the {self._part} to {angle_deg:g}°, then press Enter; or type the angle on its scale: "
        self._angle_deg = math.nan
        while not math.isfinite(self._angle_deg):
            text = person.ask(question, self._log)
            question = f"{text!r} is not an angle; type degrees, or press Enter for {angle_deg:g}: "
            try:
                self._angle_deg = float(text.removesuffix("°").replace(",", ".") or angle_deg)
            except ValueError:
                continue

    def position(self) -> float:
        return self._angle_deg

    def halt(self) -> None: ...
