"""In: frames as they are found good or bad. Out: `rig.json`, what was asked and came, and `capture.toml` made of it.

Both are whole at every moment; `rig.json` is written first, so that capture.toml never knows more.
"""

import os
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from polcap.errors import CaptureError
from polcap.formats import atomic
from polcap.formats.capture import capture_toml
from polcap.formats.raw import file_bytes
from polcap.images import Role
from polcap.rig import frame_check
from polcap.rig.camera import Exposure
from polcap.rig.plan import Order, Slot

NAME, LOG, REJECTED = "rig.json", "rig.log", "rejected"
SAME_DEG = 0.1  # a bracket's frames are of one angle up to here


class Good(msgspec.Struct, frozen=True):
    """A frame of the capture."""

    file: str
    role: Role
    angle_deg: float | None  # asked for
    step: int
    read_deg: float | None  # read back, beside angle_deg and not modulo 360
    exposure: Exposure  # really set
    flash: bool
    camera_file: str
    facts: frame_check.Facts


class Bad(msgspec.Struct, frozen=True):
    """A frame kept aside."""

    file: str
    slot: str
    read_deg: float | None
    reason: str


class Content(msgspec.Struct):
    """All of rig.json."""

    order: Order
    rotator: str = ""  # model
    camera: str = ""
    frames: dict[str, Good] = {}  # by slot
    rejected: list[Bad] = []


class Record:
    """What a capture folder holds so far. Threads take turns."""

    def __init__(self, folder: Path, content: Content, slots: tuple[Slot, ...]) -> None:
        self.folder = folder
        self.content = content
        self.slots = slots
        self._lock = threading.RLock()

    def missing(self, pending: Iterable[Slot]) -> list[Slot]:
        with self._lock:
            return [slot for slot in self.slots if slot.name not in self.content.frames and slot not in pending]

    def good(self) -> dict[str, Good]:
        with self._lock:
            return dict(self.content.frames)

    def keep(self, slot: Slot, good: Good) -> None:
        with self._lock:
            self.content.frames[slot.name] = good
            self.write()

    def reject(self, slot_name: str, file: Path, read_deg: float | None, reason: str) -> Path:
        """Put a photograph aside, never over another; raises StorageError."""
        with self._lock:
            flat = slot_name.replace("/", "_")
            places = (self.folder / REJECTED / f"{flat}.try{n}{file.suffix}" for n in range(1, 1 << 20))
            aside = next(place for place in places if not place.exists())
            self.content.frames.pop(slot_name, None)
            try:
                aside.parent.mkdir(exist_ok=True)
                os.replace(file, aside)
            except OSError as error:
                raise atomic.failure(aside, error) from error
            self.content.rejected.append(Bad(aside.relative_to(self.folder).as_posix(), slot_name, read_deg, reason))
            self.write()
            return aside

    def arrived_again(self, slot: Slot, read_deg: float) -> list[str]:
        """The ring came to an angle again: frames of a bracket that was begun elsewhere are put aside."""
        with self._lock:
            begun = {name: good for name, good in self.content.frames.items() if _bracket(good) == _bracket(slot)}
            read = [good.read_deg for good in begun.values() if good.read_deg is not None]
            if not read or max(abs(one - read_deg) for one in read) <= SAME_DEG:
                return []
            for name, good in begun.items():
                reason = f"the ring came back to {read_deg:.3f}°, not {good.read_deg:.3f}°"
                self.reject(name, self.folder / good.file, good.read_deg, reason)
            return list(begun)

    def write(self) -> None:
        with self._lock:
            with atomic.path(self.folder / NAME) as temporary:
                temporary.write_bytes(msgspec.json.format(msgspec.json.encode(self.content), indent=1))
            with atomic.path(self.folder / capture_toml.NAME) as temporary:
                temporary.write_text(tomli_w.dumps(self._toml()), encoding="utf-8")

    def stated_deg(self, good: Good) -> float | None:
        """The angle capture.toml states: the mean of the bracket's; an ambient frame has its shot's."""
        if good.angle_deg is None:
            return None
        kind = "repeat" if good.role == "repeat" else "shot"
        frames_ = self.content.frames.values()
        read = [one.read_deg for one in frames_ if _bracket(one) == (kind, good.angle_deg) and one.read_deg is not None]
        read = read or ([] if good.read_deg is None else [good.read_deg])
        return round(sum(read) / len(read), 4) if read else None

    def _toml(self) -> dict[str, Any]:
        entries = []
        for slot in self.slots:
            good = self.content.frames.get(slot.name)
            if good is None:
                continue
            stated = self.stated_deg(good)
            entry: dict[str, Any] = {"file": good.file}
            entry |= {} if stated is None else {"angle": stated}
            entry |= {} if good.role == "shot" else {"role": good.role}
            entry |= {"flash_energy": good.exposure.flash} if good.exposure.flash and good.flash else {}
            entries.append(entry)
        return {"rotator": {"model": self.content.rotator, "log": LOG}, "frame": entries}


def _bracket(of: Good | Slot) -> tuple[str, float | None]:
    return of.role, of.angle_deg


def load(folder: Path) -> Content | None:
    """What an earlier run left, or None. Raises CaptureError."""
    file = folder / NAME
    if not file.exists():
        return None
    try:
        return msgspec.json.decode(file.read_bytes(), type=Content)
    except (OSError, msgspec.MsgspecError) as error:
        raise CaptureError(f"{file}: cannot be read ({error}); shoot into another folder") from None


def verify(record: Record) -> list[str]:
    """Frames that are not what was recorded are put aside; and so are files that nobody recorded. Returns what for."""
    said = []
    for name, good in list(record.content.frames.items()):
        file = record.folder / good.file
        if not file.is_file():
            del record.content.frames[name]
            said.append(f"{good.file}: is gone; it is taken again")
        elif file_bytes.digest(file.read_bytes()) != good.facts.digest:
            record.reject(name, file, good.read_deg, "changed since it was taken")
            said.append(f"{good.file}: changed since it was taken; it is taken again")
    known = {good.file for good in record.content.frames.values()}
    for slot in record.slots:
        for file in sorted((record.folder / slot.name).parent.glob(f"{Path(slot.name).name}.*")):
            if file.relative_to(record.folder).as_posix() not in known:
                record.reject(slot.name, file, None, "left by an interrupted run before it was checked")
                said.append(f"{file.relative_to(record.folder)}: was not checked yet; it is taken again")
    for left in record.folder.rglob(".*.part*"):
        atomic.discard(left)
    return said


def without_port(url: str) -> str:
    """A device's URL without the port, which may be another after the cable was plugged in again."""
    head, _, query = url.partition("?")
    return f"{head.partition(':')[0]}?{query}"


def remedy(value: Any) -> str:
    """How to have a setting so again."""
    if isinstance(value, bool):
        return "give it" if value else "leave it out"
    if isinstance(value, tuple):
        listed = ", ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in value)
        return f"give {listed}" if listed else "leave it out"
    return f"give {value}"
