"""A rig that does not exist: in come angles and exposures, out the RAW files a camera would have made of them.

The motor stops a little beside the angle it reports and tells the camera where; the camera renders through
`polcap.synth`, so that a dry run yields a real capture with a known truth.
"""

import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated
from urllib.parse import parse_qsl

import msgspec
import numpy as np
from msgspec import Meta

from polcap import config
from polcap.errors import SettingError
from polcap.images import Floats, Role
from polcap.rig.camera import Exposure, Shot
from polcap.rig.log import Log
from polcap.synth.shooting import MIDDLE_S, Kind, Shoot, Studio, Take, random_scene

BACKLASH_DEG = 2.0
_NUMBER_OF_ROLE = {"shot": 0, "repeat": 1000, "ambient": 2000, "chart": 3000, "cross": 4000}


class Settings(msgspec.Struct, frozen=True):
    """Own settings of the simulated motor's URL."""

    seed: Annotated[int, Meta(ge=0)] = 0
    error: Annotated[float, Meta(ge=0, le=5)] = 0.05  # degrees, 1σ, between the position reported and the true one
    play: Annotated[float, Meta(ge=0, le=45)] = 0.5  # degrees, of the gear; shows where it comes from above
    speed: Annotated[float, Meta(gt=0)] = 360.0  # degrees/s


class Ring:
    """What motor and camera share: the polarizer."""

    true_deg: float | None = None  # None: no simulated motor turns it


RING = Ring()


class Motor:
    """Turns `RING`; the same position has the same error every time."""

    model = "Polcap Synthetic rotator"
    wraps = False

    def __init__(self, settings: Settings, log: Log) -> None:
        self.speed_deg_s = settings.speed
        self._settings = settings
        self._log = log
        self._at = 0.0  # as reported
        self._turn(0.0)

    def home(self) -> None:
        self._turn(0.0)

    def go(self, angle_deg: float) -> None:
        self._turn(angle_deg)

    def where(self) -> float:
        self._log.write("rotator", "<", f"{self._at:.3f}")
        return self._at

    def halt(self) -> None:
        self._log.write("rotator", ">", "halt")

    def close(self) -> None:
        RING.true_deg = None

    def _turn(self, angle_deg: float) -> None:
        self._log.write("rotator", ">", f"go {angle_deg:.3f}")
        time.sleep(abs(angle_deg - self._at) / self.speed_deg_s)
        random = np.random.default_rng([self._settings.seed, round(1000 * (angle_deg % 360.0))])
        error = self._settings.error * float(random.normal())
        RING.true_deg = angle_deg + error + (self._settings.play if angle_deg < self._at else 0.0)
        self._at = angle_deg


def open_motor(port: str, settings: Settings, limit_s: float, log: Log) -> Motor:
    if port:
        raise SettingError(f"rotator simulated:{port}: the simulated motor has no port; write simulated")
    return Motor(settings, log)


class Subject(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands before the simulated camera, beside the settings of `synth.Shoot`."""

    scene: Kind = "bumps"
    seed: Annotated[int, Meta(ge=0)] = 0


class Camera:
    """`simulated?seed=1&width=384`: any setting of `polcap synth`, and `scene`. A tripod: it does not move."""

    model = "Polcap Synthetic"
    switches_flash = polarizes_flash = True

    def __init__(self, query: str, log: Log) -> None:
        self._subject, self._shoot = understood(query)
        self._log = log
        self._studio: Studio | None = None
        self._seen: dict[tuple[float, bool], Floats] = {}  # what passes at an angle, the flash's filter off or on
        self._taken: Counter[tuple[int, int, bool]] = Counter()
        self._next = (0, 0, 0.0)  # shot, frame, true angle in degrees
        self._crossed = False  # the flash's filter is on
        self.frame_bytes = 2 * self._shoot.width * self._shoot.height

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """By time: its lamp is on as long as its shutter is open."""
        stops = [self._shoot.step ** (frame - self._shoot.exposures // 2) for frame in range(self._shoot.exposures)]
        return tuple(Exposure(time_s=MIDDLE_S * stop, f_number=11.0, iso=100.0) for stop in stops)

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Noise and time stamp of a shot are those of `synth.write`."""
        angles = self._shoot.angles_deg
        asked = 0.0 if angle_deg is None else angle_deg
        shot = angles.index(asked) if asked in angles else len(angles) + round(10 * asked) % 900
        self._crossed = role == "cross"
        self._next = shot + _NUMBER_OF_ROLE[role], step, asked if RING.true_deg is None else RING.true_deg

    def shoot(self, exposure: Exposure, flash: bool) -> Shot:
        if exposure.flash or exposure.iso not in (None, 100.0) or exposure.f_number not in (None, 11.0):
            raise SettingError(f"the simulated camera has f/11, ISO 100 and no flash power, not {exposure}; give times")
        self._studio = self._studio or Studio(random_scene(self._subject.seed, self._subject.scene), self._shoot)
        shot, step, angle = self._next
        if (angle, self._crossed) not in self._seen:
            look = self._studio.crossed_at if self._crossed else self._studio.through
            self._seen = {(angle, self._crossed): look(angle)}
        time_s = exposure.time_s or MIDDLE_S
        take = Take(shot, step, time_s / MIDDLE_S, self._taken[shot, step, flash], flash)
        self._taken[shot, step, flash] += 1
        self._log.write("camera", ">", f"{exposure}, {'lit' if flash else 'dark'}, polarizer at {angle:.4f}°")
        with tempfile.TemporaryDirectory() as place:
            file = Path(place) / f"SIM_{shot}_{step}.DNG"
            self._studio.photograph(file, self._seen[angle, self._crossed], take)
            data = file.read_bytes()
        self._log.write("camera", "<", f"{len(data)} bytes")
        return Shot(data, file.name, Exposure(time_s=time_s, f_number=11.0, iso=100.0))

    def close(self) -> None:
        self._seen = {}


def understood(query: str) -> tuple[Subject, Shoot]:
    """What a query states, strictly. Raises SettingError."""
    pairs = parse_qsl(query, keep_blank_values=True)
    own = [f"{name}={value}" for name, value in pairs if name in Subject.__struct_fields__]
    rest = [f"{name}={value}" for name, value in pairs if name not in Subject.__struct_fields__ or name == "seed"]
    still = {"width": 768, "height": 576, "nudge_px": 0.0, "nudge_deg": 0.0, "angle_error_deg": 0.0}
    try:
        subject, shoot = config.fill(Subject, {}, own), config.fill(Shoot, still, rest)
    except SettingError as error:
        raise SettingError(f"--camera simulated?{query}: {str(error).removeprefix('--set ')}") from None
    if shoot.bracket != "time":
        raise SettingError(f"--camera simulated?bracket={shoot.bracket}: only time is simulated; leave it out")
    return subject, shoot
