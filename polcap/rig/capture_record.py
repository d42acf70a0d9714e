"""Record of a capture while it is shot: accepted and rejected frames in `rig.json`, and `capture.toml` made from it.

Both files are complete at every moment. `rig.json` is written first, so `capture.toml` never has more frames.
"""

import os
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tomli_w

from polcap.capture_values import Role
from polcap.errors import CaptureError, StorageError
from polcap.formats import atomic, system_errors, text_file
from polcap.formats.capture import capture_toml, unfinished
from polcap.formats.raw import file_bytes
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.retake_criteria import FrameFacts
from polcap.rig.shooting_plan import CaptureOrder, Slot

T = TypeVar("T")
NAME, LOG, REJECTED = unfinished.RECORD, "rig.log", "rejected"
_SAME_DEG = 0.1  # the frames of a bracket are at one angle up to this


class AcceptedFrame(msgspec.Struct, frozen=True):
    """An accepted photograph of a capture, as recorded in rig.json."""

    file: str
    role: Role
    angle_deg: float | None  # requested
    step: int  # within the bracket
    read_deg: float | None  # read back from the rotator; near angle_deg, not modulo 360
    exposure: Exposure  # settings with which the camera took it
    flash: bool
    camera_file: str
    facts: FrameFacts


class RejectedFrame(msgspec.Struct, frozen=True):
    """A photograph that was rejected and moved to the folder `rejected`, as recorded in rig.json."""

    file: str
    slot: str
    read_deg: float | None
    reason: str


class RigFile(msgspec.Struct):
    """Content of rig.json: options of the capture, devices, accepted and rejected photographs."""

    order: CaptureOrder
    rotator: str = ""  # model
    camera: str = ""
    frames: dict[str, AcceptedFrame] = {}  # by slot
    unchecked: dict[str, str] = {}  # digests of photographs that are saved but not yet accepted, by file
    rejected: list[RejectedFrame] = []


class CaptureRecord:
    """Accepted and rejected frames of a capture folder; used by the shooting thread and the checking thread."""

    def __init__(self, folder: Path, content: RigFile, slots: tuple[Slot, ...]) -> None:
        self.folder = folder
        self.content = content
        self.slots = slots
        self._lock = threading.RLock()

    def missing(self, pending: Iterable[Slot] = ()) -> list[Slot]:
        """Frames of the plan that have no accepted photograph and none under check."""
        return [slot for slot in self.slots if slot.name not in self.content.frames and slot not in pending]

    def accepted(self) -> dict[str, AcceptedFrame]:
        with self._lock:
            return dict(self.content.frames)

    def save(self, name: str, photograph: bytes) -> Path:
        """Write a photograph into the capture folder, recorded as unchecked, and return its path.

        Raises StorageError: it cannot be written, or a file that polcap did not write has its name.
        """
        file = self.folder / name
        with self._lock:
            if os.path.lexists(file):
                raise StorageError(f"cannot write {file}: polcap did not write the file that is there; move it away")
            self.content.unchecked[name] = file_bytes.digest(photograph)
            self.write()
        atomic.write(file, photograph)
        return file

    def accept(self, slot: Slot, frame: AcceptedFrame) -> None:
        with self._lock:
            self.content.unchecked.pop(frame.file, None)
            self.content.frames[slot.name] = frame
            self.write()

    def reject(self, slot_name: str, file: Path, read_deg: float | None, reason: str) -> str:
        """Move a photograph to the folder `rejected`, never over another, and empty its slot. Raises StorageError."""
        with self._lock:
            stem = slot_name.replace("/", "_")
            names = (f"{REJECTED}/{stem}.try{n}{file.suffix}" for n in range(1, 1 << 20))
            name = next(name for name in names if not (self.folder / name).exists())
            self.content.frames.pop(slot_name, None)
            self.content.unchecked.pop(file.relative_to(self.folder).as_posix(), None)
            try:
                (self.folder / REJECTED).mkdir(exist_ok=True)
                os.replace(file, self.folder / name)
            except OSError as error:
                raise system_errors.cannot_write(self.folder / name, error) from error
            self.content.rejected.append(RejectedFrame(name, slot_name, read_deg, reason))
            self.write()
            return name

    def reject_other_angle(self, slot: Slot, read_deg: float) -> list[str]:
        """Reject the frames of a begun bracket to which the ring has returned, if they were taken at another angle."""
        bracket = {name: frame for name, frame in self.accepted().items() if _bracket(frame) == _bracket(slot)}
        read = [frame.read_deg for frame in bracket.values() if frame.read_deg is not None]
        if not read or max(abs(one - read_deg) for one in read) <= _SAME_DEG:
            return []
        for name, frame in bracket.items():
            reason = f"the ring came back to {read_deg:.3f}°, not {frame.read_deg:.3f}°"
            self.reject(name, self.folder / frame.file, frame.read_deg, reason)
        return list(bracket)

    def verify(self) -> list[str]:
        """Reject photographs that have changed since, or were not checked; returns a message for each."""
        messages = []
        for name, frame in self.accepted().items():
            file = self.folder / frame.file
            if not file.is_file():
                del self.content.frames[name]
                messages.append(f"{frame.file}: the file is missing; the frame is taken again")
            elif file_bytes.digest(file.read_bytes()) != frame.facts.digest:
                self.reject(name, file, frame.read_deg, "changed since it was taken")
                messages.append(f"{frame.file}: changed since it was taken; the frame is taken again")
        for name, digest in list(self.content.unchecked.items()):
            file = self.folder / name
            if file.is_file() and file_bytes.digest(file.read_bytes()) == digest:
                self.reject(name.rpartition(".")[0], file, None, "not checked before the run was interrupted")
                messages.append(f"{name}: was not checked before the interruption; the frame is taken again")
            self.content.unchecked.pop(name, None)
        for temporary in self.folder.rglob(".*.part*"):
            if atomic.is_temporary(temporary.name):
                atomic.discard(temporary)
        return messages

    def write(self) -> None:
        """Write rig.json, then capture.toml; keys that the user added, such as [catalog], do not change.

        Raises StorageError; CaptureError if capture.toml was edited and is wrong.
        """
        with self._lock:
            atomic.write_json(self.folder / NAME, self.content)
            capture_toml.load(self.folder)
            file = self.folder / capture_toml.NAME
            stated = text_file.read_toml(file) if file.exists() else {}
            atomic.write(file, tomli_w.dumps(stated | self._toml()))

    def stated_deg(self, frame: AcceptedFrame) -> float | None:
        """Angle [degrees] for capture.toml: mean over the frame's bracket; for an ambient frame that of its shot."""
        if frame.angle_deg is None:
            return None
        bracket = "repeat" if frame.role == "repeat" else "shot", frame.angle_deg
        read = [one.read_deg for one in self.content.frames.values() if _bracket(one) == bracket]
        angles = [one for one in read or [frame.read_deg] if one is not None]
        return round(sum(angles) / len(angles), 4) if angles else None

    def _toml(self) -> dict[str, Any]:
        """Content of capture.toml: file, angle, role and flash energy of each accepted frame."""
        entries = []
        for frame in (self.content.frames[slot.name] for slot in self.slots if slot.name in self.content.frames):
            stated = self.stated_deg(frame)
            entry: dict[str, Any] = {"file": frame.file}
            entry |= {} if stated is None else {"angle": stated}
            entry |= {} if frame.role == "shot" else {"role": frame.role}
            entry |= {"flash_energy": frame.exposure.flash} if frame.exposure.flash and frame.flash else {}
            entries.append(entry)
        return {"rotator": {"model": self.content.rotator, "log": LOG}, "frame": entries}


def load(folder: Path) -> RigFile | None:
    """The rig.json of an earlier run, or None. Raises CaptureError."""
    return read(folder / NAME, RigFile) if (folder / NAME).exists() else None


def read(file: Path, kind: type[T]) -> T:
    """Read a file of this package, rig.json or views.json. Raises CaptureError."""
    try:
        return msgspec.convert(text_file.read_json(file), kind)
    except (OSError, ValueError) as error:
        raise CaptureError(f"{file}: cannot be read ({error}); shoot into another folder") from None


def _bracket(frame: AcceptedFrame | Slot) -> tuple[str, float | None]:
    """Role and angle, which all frames of a bracket share."""
    return frame.role, frame.angle_deg
