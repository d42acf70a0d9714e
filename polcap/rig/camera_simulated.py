"""Camera driver for `simulated`: renders each RAW file with `polcap.synth` at the simulated ring's true angle."""

import tempfile
from collections import Counter
from pathlib import Path
from urllib.parse import parse_qsl

from polcap import config
from polcap.capture_values import Role
from polcap.errors import SettingError
from polcap.image_values import Floats
from polcap.rig.camera import CameraFile
from polcap.rig.device_log import Log
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.motor_simulated import RING
from polcap.synth.scenes import Kind, random_scene
from polcap.synth.shooting import MIDDLE_S, Dials, Shoot, Studio, Take

FLASH_SYNC_S = 1 / 160  # shutter time under the flash
_FIRST_NUMBER = {"shot": 0, "repeat": 1000, "ambient": 2000, "chart": 3000, "cross": 4000}  # of the shots of a role


class SimulatedCameraSettings(Shoot, frozen=True, forbid_unknown_fields=True):
    """Settings in the URL of the simulated camera: those of `polcap synth`, and the kind of scene."""

    scene: Kind = "bumps"


class SimulatedCamera:
    """A simulated camera that does not move, such as `simulated?seed=1&width=384`.

    The URL takes the settings of `polcap synth`, and `scene`. Brackets may vary shutter time, aperture, ISO and flash
    power.
    """

    model = "Polcap Synthetic"
    switches_flash = polarizes_flash = True

    def __init__(self, query: str, log: Log) -> None:
        self._shoot = parse_query(query)
        self._log = log
        self._studio: Studio | None = None
        self._rendered: dict[tuple[float, bool], Floats] = {}  # by angle and by whether the flash has its filter
        self._taken: Counter[tuple[int, int, bool]] = Counter()  # photographs by shot, frame and flash
        self._next = (0, 0, 0.0)  # shot, frame, true angle in degrees
        self._crossed = False  # the flash's filter is on
        self.frame_bytes = 2 * self._shoot.width * self._shoot.height

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """Default exposures: steps of exposure time, because the simulated lamp is steady."""
        stops = [self._shoot.step ** (frame - self._shoot.exposures // 2) for frame in range(self._shoot.exposures)]
        return tuple(Exposure(time_s=MIDDLE_S * stop, f_number=11.0, iso=100.0) for stop in stops)

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Set up the next frame: number of its shot and of the frame in it, and the true angle of the polarizer.

        The numbers give the seed of the noise and the time stamp, as in `synth.write`. Angles that the simulated shoot
        does not have get numbers of their own.
        """
        angles = self._shoot.angles_deg
        wanted = 0.0 if angle_deg is None else angle_deg
        shot = angles.index(wanted) if wanted in angles else len(angles) + round(10 * wanted) % 900  # under 1000
        self._crossed = role == "cross"
        self._next = shot + _FIRST_NUMBER[role], step, wanted if RING.true_deg is None else RING.true_deg

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """Photograph the prepared frame, lit if `flash`; the light is rendered once for all exposures at one angle."""
        self._studio = self._studio or Studio(random_scene(self._shoot.seed, self._shoot.scene), self._shoot)
        shot, step, angle = self._next
        if (angle, self._crossed) not in self._rendered:
            self._rendered = {(angle, self._crossed): self._studio.through(angle, self._crossed)}
        is_flash = exposure.time_s is None or exposure.flash is not None  # else a lamp, as in `exposure_factor`
        dials = Dials(exposure.time_s or FLASH_SYNC_S, exposure.f_number or 11.0, exposure.iso or 100.0, is_flash)
        take = Take(shot, step, exposure_factor(exposure), self._taken[shot, step, flash], flash, dials)
        self._taken[shot, step, flash] += 1
        self._log.write("camera", ">", f"{exposure}, {'lit' if flash else 'dark'}, polarizer at {angle:.4f}°")
        with tempfile.TemporaryDirectory() as place:
            file = Path(place) / f"SIM_{shot}_{step}.DNG"
            self._studio.photograph(file, self._rendered[angle, self._crossed], take)
            data = file.read_bytes()
        self._log.write("camera", "<", f"{len(data)} bytes")
        return CameraFile(data, file.name, Exposure(dials.time_s, dials.f_number, dials.iso, exposure.flash))

    def close(self) -> None:
        self._rendered = {}


def exposure_factor(exposure: Exposure) -> float:
    """Exposure relative to the middle frame of a bracket; what is not stated is that of the middle frame.

    The light is a flash if its power is stated or no time is; otherwise a steady lamp. Exposed as the middle frame:
    the lamp at 1/50 s, f/11 and ISO 100; the flash at power 1/16, f/11 and ISO 100, or at f/11 and ISO 400.
    """
    aperture, iso = (11.0 / (exposure.f_number or 11.0)) ** 2, exposure.iso or 100.0
    if exposure.flash:
        return aperture * 16 * exposure.flash * iso / 100
    if exposure.time_s is None:
        return aperture * (exposure.iso or 400.0) / 400
    return aperture * exposure.time_s / MIDDLE_S * iso / 100


def parse_query(query: str) -> SimulatedCameraSettings:
    """Parse the settings in the URL of a simulated camera; unknown ones raise SettingError."""
    assignments = [f"{name}={value}" for name, value in parse_qsl(query, keep_blank_values=True)]
    defaults = {"width": 768, "height": 576, "nudge_px": 0.0, "nudge_deg": 0.0, "angle_error_deg": 0.0}
    try:
        shoot = config.fill(SimulatedCameraSettings, defaults, assignments)
    except SettingError as error:
        raise SettingError(f"--camera simulated?{query}: {error}") from None
    if shoot.bracket != "time":
        raise SettingError(f"--camera simulated?bracket={shoot.bracket}: only time is simulated; leave it out")
    return shoot
