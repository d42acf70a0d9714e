"""What polcap itself costs per frame of a 3 × 3 capture of 24 MP, the devices' own time excluded.

python tests/benchmarks/bench_rig_overhead.py

The camera takes 1 s a frame, the motor nothing; frames are 24 MP DNGs of 48 MB. Counted is the time between the
camera's return and the next call to a device, while the frame before is saved and checked in the background, and the
processor's time for it; and, apart, from the last frame to the end (its check, the preview, reading the capture).
"""

import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

from polcap.images import Exif, Role
from polcap.rig import sequence
from polcap.rig.camera import CameraFile
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.shooting_plan import CaptureOrder
from tests.raw_files import write_raw
from tests.rig.pool import BRACKET

_DEVICE_S = 1.0
_SIZE = 4000, 6000  # px


class Clock:
    """Sums the time that passes outside the devices."""

    def __init__(self) -> None:
        self.left = time.perf_counter()
        self.busy = time.thread_time()
        self.gaps: list[tuple[float, float]] = []  # s on the wall, s of the processor

    def back(self) -> None:
        self.gaps.append((time.perf_counter() - self.left, time.thread_time() - self.busy))

    def away(self) -> None:
        self.left, self.busy = time.perf_counter(), time.thread_time()


class Camera:
    model, frame_bytes, switches_flash, polarizes_flash = "Bench", 50_000_000, False, False

    def __init__(self, clock: Clock, frames: list[bytes]) -> None:
        self.clock, self.frames = clock, iter(frames)

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None: ...

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        self.clock.back()
        time.sleep(_DEVICE_S)
        shot = CameraFile(next(self.frames), "B.DNG", exposure)
        self.clock.away()
        return shot

    def close(self) -> None: ...


class Rotator:
    model, speed_deg_s, settle_s, by_hand = "Bench", 1e9, 0.0, False

    def home(self) -> None: ...

    def move(self, angle_deg: float) -> float:
        return angle_deg

    def close(self) -> None: ...


def main() -> None:
    clock = Clock()
    with tempfile.TemporaryDirectory() as place:
        frames = [_frame(Path(place) / "x.dng", number) for number in range(9)]
        order = CaptureOrder((0.0, 45.0, 90.0), BRACKET, rotator="simulated", camera="simulated")
        camera = Camera(clock, frames)
        with (
            mock.patch("polcap.rig.device_urls.open_camera", lambda name, log: camera),
            mock.patch("polcap.rig.device_urls.open_rotator", lambda url, log: Rotator()),
        ):
            sequence.shoot(Path(place) / "c", order)
        end = time.perf_counter() - clock.left
    gaps, busy = 1000 * np.array(clock.gaps[1:]).T  # ms; the first is the start
    print(f"{len(frames[0]) / 1e6:.0f} MB a frame, {_DEVICE_S:g} s of device time each")
    print(f"polcap between frames: median {np.median(gaps):.1f} ms, most {gaps.max():.1f} ms (limit 50 ms)")
    print(f"of the processor: median {np.median(busy):.1f} ms, most {busy.max():.1f} ms")
    print(f"after the last frame: {end:.2f} s")


def _frame(path: Path, number: int) -> bytes:
    random = np.random.default_rng(number)
    tile = random.integers(600, 9000, (_SIZE[0] // 8, _SIZE[1] // 8)).astype(np.uint16)
    exif = Exif(make="Bench", model="24", exposure_time=BRACKET[number % 3].time_s, f_number=11.0, iso=100.0)
    return write_raw(path, np.tile(tile, (8, 8)), exif)


if __name__ == "__main__":
    main()
