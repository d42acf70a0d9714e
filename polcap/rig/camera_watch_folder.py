"""Camera driver for `folder:PATH`: waits for the RAW files that a tethering program writes into a folder.

The files belong to the photographer: they are read, never moved, renamed or removed.
"""

import time
from pathlib import Path

from polcap.errors import DecodeError, HardwareError, SettingError
from polcap.formats.raw import probe
from polcap.images import Role
from polcap.rig.camera import CameraFile
from polcap.rig.device_log import Log
from polcap.rig.exposure_bracket import Exposure

_POLL_S = 0.1
_STABLE_S = 0.5  # a file that has not grown for this long is complete


class WatchFolderCamera:
    """A camera that the photographer, or a tethering program, releases."""

    model = "tethering folder"
    switches_flash = polarizes_flash = False
    frame_bytes = 60_000_000

    def __init__(self, path: str, log: Log, timeout_s: float = 600.0, stable_s: float = _STABLE_S) -> None:
        self._folder = Path(path)
        if not self._folder.is_dir():
            raise SettingError(f"--camera folder:{path}: no such folder; give the one the tethering program writes to")
        self._log = log
        self._timeout_s = timeout_s
        self._stable_s = stable_s
        self._seen = set(self._files())
        self._angle: float | None = None

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        raise SettingError("--camera folder cannot ask the camera; give its exposures with --bracket 1/200,1/50,1/13")

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Skip the files that arrived at the angle before."""
        if angle_deg != self._angle:
            for file in sorted(set(self._files()) - self._seen):
                self._log.write("camera", "!", f"{file.name}: taken before the polarizer turned; not used")
                self._seen.add(file)
        self._angle = angle_deg

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """The next new RAW, when it is complete; files that arrive together are taken in the order of their names."""
        self._log.write("camera", ">", f"{exposure}, {'lit' if flash else 'dark'}: waiting")
        end = time.monotonic() + self._timeout_s
        unchanged: dict[tuple[Path, int], float] = {}  # time at which a file first had a size
        refused: set[tuple[Path, int]] = set()  # files that were no RAW at a size
        fault = ""  # of the last file that could not be read
        while time.monotonic() < end:
            for file in sorted(set(self._files()) - self._seen):
                try:
                    key = file, file.stat().st_size
                    complete = time.monotonic() - unchanged.setdefault(key, time.monotonic()) >= self._stable_s
                    if not complete or key in refused:
                        continue
                    refused.add(key)  # a JPEG, or a RAW that is still being written
                    if probe.read(file).kind == "raw":
                        data = file.read_bytes()
                        self._seen.add(file)
                        self._log.write("camera", "<", f"{file.name}, {len(data)} bytes")
                        return CameraFile(data, file.name, exposure)
                except (DecodeError, OSError) as error:  # removed, or damaged
                    fault = f" ({error})"
            time.sleep(_POLL_S)
        raise HardwareError(
            f"no new RAW file in {self._folder} within {self._timeout_s:g} s{fault}; "
            "check that the tethering program writes RAW files there"
        )

    def close(self) -> None:
        """Nothing to disconnect from."""

    def _files(self) -> list[Path]:
        try:
            return [path for path in self._folder.iterdir() if path.is_file() and not path.name.startswith(".")]
        except OSError as error:
            reason = f"{error.strerror}; is its disk still there?"
            raise HardwareError(f"{self._folder} cannot be listed: {reason}") from None
