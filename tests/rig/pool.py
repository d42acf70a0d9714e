"""A camera that returns prepared photographs, with a planted fault; much faster than rendering each."""

import gc
import resource
import signal
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from polcap.capture_values import Exif, Role
from polcap.errors import HardwareError
from polcap.formats.raw.file_bytes import digest
from polcap.rig.camera import CameraFile
from polcap.rig.camera_gphoto2 import call_within
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.shooting_plan import CaptureOrder
from polcap.synth.scenes import random_scene
from polcap.synth.shooting import MIDDLE_S, Shoot, Studio, Take
from tests.raw_files import write_raw

ANGLES = (0.0, 45.0, 90.0)
BRACKET = tuple(Exposure(time_s=time, f_number=11.0, iso=100.0) for time in (0.005, 0.02, 0.08))
ORDER = CaptureOrder(angles_deg=ANGLES, bracket=BRACKET, repeat_deg=(45.0,), ambient=True, camera="simulated")
CAMERA_FAULTS = ("stall", "disconnect", "card-full", "disk-full", "corrupt", "stale", "ctrl-c", "kill")

Key = tuple[str, float, int]  # role, angle, step


def photographs(width: int = 192, height: int = 144, scene_seed: int = 1) -> dict[Key, bytes]:
    """Every frame of `ORDER`, and those of 135°, a wrong angle of the ring."""
    shoot = Shoot(width=width, height=height, samples=1)
    studio = Studio(random_scene(scene_seed, "bumps"), shoot)
    found: dict[Key, bytes] = {}
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "frame.dng"
        for number, angle in enumerate((*ANGLES, 135.0)):
            light = studio.through(angle)
            for again, role in enumerate(("shot", "repeat")):
                for step, exposure in enumerate(BRACKET):
                    studio.photograph(file, light, Take(number, step, (exposure.time_s or 1) / MIDDLE_S, again))
                    found[role, angle, step] = file.read_bytes()
            studio.photograph(file, light, Take(number, 7, 4.0, lit=False))
            found["ambient", angle, 2] = file.read_bytes()
    return found


def tiny(path: Path, **exif: object) -> bytes:
    """A RAW of noise, 32×24 px, for tests of bytes and tags."""
    tags = {"make": "Tiny", "model": "One", "lens": "L", "exposure_time": 0.02, "f_number": 11.0, "iso": 100.0}
    random = np.random.default_rng([*repr(exif).encode()])
    mosaic = random.integers(600, 9000, (24, 32)).astype(np.uint16)
    return write_raw(path, mosaic, Exif(**{**tags, **exif}))  # type: ignore[arg-type]


def virtual_gphoto2(monkeypatch: pytest.MonkeyPatch, card: Path) -> None:
    """Connect libgphoto2's virtual camera, which photographs the file `card`/x.jpg; skips without gphoto2."""
    gphoto2 = pytest.importorskip("gphoto2")
    gc.collect()  # while an earlier virtual camera exists in this process, a new one photographs the earlier one's card
    monkeypatch.setenv("IOLIBS", str(Path(gphoto2.__file__).parent / "libgphoto2" / "vusb"))
    monkeypatch.setenv("VCAMERADIR", f"{card}/")


class PoolCamera:
    """Checks the ring's true angle; `fault` strikes once, at the frame number `at`."""

    model = "Polcap Synthetic"
    frame_bytes = 100_000
    switches_flash = polarizes_flash = True

    def __init__(
        self, pool: dict[Key, bytes], true_deg: Callable[[], float] | None = None, fault: str = "", at: int = 1
    ) -> None:
        assert not fault or fault in CAMERA_FAULTS
        self.pool, self.true_deg, self.fault, self.at = pool, true_deg, fault, at
        self.delivered: list[tuple[Key, str]] = []
        self.closed = False
        self._last = b""

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        return BRACKET

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        assert angle_deg is not None
        if self.true_deg is not None:
            here = self.true_deg() % 180
            assert min(abs(here - angle_deg), 180 - abs(here - angle_deg)) < 0.1, "a frame at a wrong angle"
        self._key = role, angle_deg, step

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        data = self.pool[self._key]
        due = len(self.delivered) + 1 == self.at
        fault, self.fault = (self.fault, "") if due else ("", self.fault)
        if fault == "stall":
            call_within(0.5, "camera: capture", threading.Event().wait)
        elif fault in ("disconnect", "card-full"):
            raise HardwareError(f"camera: capture: {fault}")
        elif fault == "corrupt":
            data = data[: len(data) // 2]
        elif fault == "stale":
            data = self._last or bytes(len(data))
        elif fault == "disk-full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (8192, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        elif fault in ("ctrl-c", "kill"):
            signal.raise_signal(signal.SIGINT if fault == "ctrl-c" else signal.SIGKILL)
        self._last = data
        self.delivered.append((self._key, digest(data)))
        return CameraFile(data, "POOL.DNG", exposure)

    def close(self) -> None:
        self.closed = True
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
