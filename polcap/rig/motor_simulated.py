"""Motor driver for `simulated`: a ring with backlash; its true angle differs a little from the reported one.

The simulated camera reads the true angle.
"""

import time
from typing import Annotated

import numpy as np
from msgspec import Meta

from polcap.rig.device_log import Log
from polcap.rig.rotator import Backlash, RotatorSettings


class SimulatedMotorSettings(RotatorSettings, frozen=True):
    """Settings in the URL of a `simulated` rotator."""

    backlash: Backlash = 2.0
    seed: Annotated[int, Meta(ge=0)] = 0
    error: Annotated[float, Meta(ge=0, le=5)] = 0.05  # degrees, 1σ, between the angle reported and the true one
    play: Annotated[float, Meta(ge=0, le=45)] = 0.5  # degrees, of the gear; shows after a downward movement
    speed: Annotated[float, Meta(gt=0)] = 360.0  # degrees/s


class SimulatedRing:
    """True angle of the simulated polarizer, shared by the simulated motor and camera."""

    true_deg: float | None = None  # None: no simulated motor turns it


RING = SimulatedRing()


class SimulatedMotor:
    """Simulated motor that turns the shared `RING`; the same position has the same error every time."""

    model = "Polcap Synthetic rotator"
    wraps = False

    def __init__(self, settings: SimulatedMotorSettings, log: Log) -> None:
        self.speed_deg_s = settings.speed
        self._settings = settings
        self._log = log
        self._reported_deg = 0.0
        self.go(0.0)

    def home(self) -> None:
        self.go(0.0)

    def go(self, angle_deg: float) -> None:
        self._log.write("rotator", ">", f"go {angle_deg:.3f}")
        time.sleep(abs(angle_deg - self._reported_deg) / self.speed_deg_s)
        random = np.random.default_rng([self._settings.seed, round(1000 * (angle_deg % 360.0))])
        error = self._settings.error * float(random.normal())
        RING.true_deg = angle_deg + error + (self._settings.play if angle_deg < self._reported_deg else 0.0)
        self._reported_deg = angle_deg

    def position(self) -> float:
        self._log.write("rotator", "<", f"{self._reported_deg:.3f}")
        return self._reported_deg

    def halt(self) -> None:
        self._log.write("rotator", ">", "halt")
        RING.true_deg = None
