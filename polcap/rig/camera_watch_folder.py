"""Camera driver for `folder:PATH`: waits for the RAW files that a tethering program writes into a folder.

A photograph is known by its name, size and time, so a program may write each one under the same name. It counts when it
decodes, so a program may reserve its size before it copies the content. The files belong to the photographer: they are
read, never moved, renamed or removed.
"""

import os
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from polcap.capture_values import Role
from polcap.errors import DecodeError, HardwareError, SettingError
from polcap.formats import sandbox, system_errors
from polcap.formats.capture import foreign_files
from polcap.formats.raw import file_bytes, libraw, probe
from polcap.optics.resize import block_means
from polcap.rig.camera import CameraFile
from polcap.rig.device_log import Log
from polcap.rig.exposure_bracket import Exposure

_POLL_S = 0.1  # between two listings of the folder
_STABLE_S = 0.5  # a file is read when its size and time have been the same for this time
_RETRY_S = 1.0  # until a file that does not decode is read again: some drives state its time when it is closed
_SETTLE_S = 30.0  # longest wait for a file that was begun before the polarizer turned
_BLOCK_PX = 32  # no sensor has this many pixels by as many of count 0
_TAIL_BYTES = 1 << 16  # no file ends with as many zeros, or with a 64th part of zeros
_TAIL_SHARE = 64

Version = tuple[int, int]  # size and time of change of a file


class Refused(NamedTuple):
    """A file that was no whole RAW: digest of its content, and the time at which it is read again."""

    digest: str
    again_s: float


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
        self._read = self._versions()  # files that have been read, or were there before
        self._since: dict[tuple[Path, Version], float] = {}  # time at which it was first seen [s]
        self._arrived: list[tuple[Path, bytes]] = []  # read, not yet decoded
        self._refused: dict[Path, Refused] = {}
        self._known: set[str] = set()  # digests of the frames taken or skipped: a file may only get another time
        self._angle: float | None = None
        with suppress(DecodeError):  # starts the decoder, so that the first frame is not overwritten meanwhile
            probe.kind(self._folder)

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        raise SettingError("--camera folder cannot ask the camera; give its exposures with --bracket 1/200,1/50,1/13")

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Skip the files that arrived, or began to arrive, at the angle before."""
        if angle_deg != self._angle:
            arriving = self._new()
            end = time.monotonic() + _SETTLE_S
            while not all(map(self._is_stable, arriving.items())) and time.monotonic() < end:
                time.sleep(_POLL_S)
                arriving = {file: version for file, version in self._versions().items() if file in arriving}
            for file in sorted({*arriving, *self._refused, *(file for file, _ in self._arrived)}):
                self._log.write("camera", "!", f"{file.name}: taken before the polarizer turned; not used")
                with suppress(OSError):  # removed: it is the program's
                    self._known.add(file_bytes.digest(file.read_bytes()))
            self._read |= arriving
            self._arrived.clear()
            self._refused.clear()
        self._angle = angle_deg

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """The next new RAW, when it is complete; files that arrive together are taken in the order of their names."""
        self._log.write("camera", ">", f"{exposure}, {'lit' if flash else 'dark'}: waiting")
        end = time.monotonic() + self._timeout_s
        fault = ""  # of the last file that could not be decoded
        while time.monotonic() < end:
            self._collect()
            while self._arrived:
                file, data = self._arrived.pop(0)
                reason = _fault(file.name, data)
                if reason is None:
                    self._refused.pop(file, None)
                    self._known.add(file_bytes.digest(data))
                    self._log.write("camera", "<", f"{file.name}, {len(data)} bytes")
                    return CameraFile(data, file.name, exposure)
                if reason:
                    fault = f" ({reason})"
                    self._log.write("camera", "!", f"{reason}; not used yet")
                    self._refused[file] = Refused(file_bytes.digest(data), time.monotonic() + _RETRY_S)
            time.sleep(_POLL_S)
        raise HardwareError(
            f"no new RAW file in {self._folder} within {self._timeout_s:g} s{fault}; "
            "check that the tethering program writes RAW files there"
        )

    def close(self) -> None:
        """Nothing to disconnect from."""

    def _collect(self) -> None:
        """Read all new files that are stable at once, because the next photograph may overwrite them."""
        for file, version in sorted(self._new().items()):
            if self._is_stable((file, version)):
                self._read[file] = version
                self._collect_one(file)
        for file, refused in list(self._refused.items()):
            if time.monotonic() >= refused.again_s:
                self._refused[file] = refused._replace(again_s=time.monotonic() + _RETRY_S)
                self._collect_one(file)

    def _collect_one(self, file: Path) -> None:
        """Read a file that has arrived, unless it is known or was refused."""
        try:
            data = file.read_bytes()
        except OSError:  # removed: it is the program's
            return
        digest = file_bytes.digest(data)
        refused = self._refused.get(file)
        if digest not in self._known and (refused is None or digest != refused.digest):
            self._arrived.append((file, data))

    def _is_stable(self, one: tuple[Path, Version]) -> bool:
        """Whether a file has had this size and time for `stable_s`, as far as was observed."""
        return time.monotonic() - self._since.setdefault(one, time.monotonic()) >= self._stable_s

    def _new(self) -> dict[Path, Version]:
        """Files that were not yet read in their present version."""
        return {file: version for file, version in self._versions().items() if self._read.get(file) != version}

    def _versions(self) -> dict[Path, Version]:
        """Size and time of change of the files in the folder, without those of other programs."""
        found = {}
        try:
            for entry in os.scandir(self._folder):
                if entry.is_file() and not foreign_files.is_ignored_file(entry.name):
                    with suppress(FileNotFoundError):
                        status = os.stat(entry.path)
                        found[Path(entry.path)] = status.st_size, status.st_mtime_ns
        except OSError as error:
            reason = f"{error.strerror}; is its disk still there?"
            raise HardwareError(f"{self._folder} cannot be listed: {reason}") from None
        return found


def _fault(name: str, data: bytes) -> str | None:
    """Reason why a file's content is no whole RAW; empty for another kind of file; None for a RAW.

    Raises StorageError: the system's folder for temporary files is full.
    """
    with TemporaryDirectory(prefix="polcap-") as place:
        copy = Path(place) / name
        try:
            copy.write_bytes(data)
            if probe.read(copy).kind != "raw":
                return f"{name}: its content is that of no RAW file" if foreign_files.is_photograph(name, True) else ""
            sandbox.call(require_whole, copy)
        except OSError as error:
            raise system_errors.cannot_write(copy, error) from error
        except DecodeError as error:
            return str(error).replace(f"{place}{os.sep}", "")
    return None


def require_whole(path: str) -> sandbox.Answer:
    """In the child process: decode a RAW; DecodeError if a part of it holds zeros only, because it is being copied."""
    data = file_bytes.load(path)
    value = libraw.decode(path)[1]["value"]
    gray = value if value.ndim == 2 else value.mean(-1, dtype=np.float32)
    tail = data[-min(_TAIL_BYTES, len(data) // _TAIL_SHARE) :]
    if not any(tail) or not block_means(np.asarray(gray, np.float32), min(_BLOCK_PX, *gray.shape)).all():
        raise DecodeError(f"{path}: a part of it is empty; it is still being copied, or damaged")
    return {}, {}
