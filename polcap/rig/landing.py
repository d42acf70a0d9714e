"""In: photographs as they come off the camera. Out: each saved and judged, kept or put aside, while the rig goes on."""

from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from polcap.errors import CaptureError, DecodeError
from polcap.formats import atomic
from polcap.images import Floats
from polcap.rig import frame_check
from polcap.rig.camera import Shot, light
from polcap.rig.log import Log
from polcap.rig.plan import Slot
from polcap.rig.record import Good, Record

AHEAD = 4  # photographs that may wait, in memory
_BRACKETED = ("shot", "repeat")


class Landing:
    """One thread that saves and judges, in the order of taking."""

    def __init__(self, book: Record, limits: frame_check.Limits, tries: int, log: Log) -> None:
        self.small: dict[str, Floats] = {}  # every good frame of this run, small and grey
        self._book = book
        self._limits = limits
        self._tries = tries
        self._log = log
        self._thread = ThreadPoolExecutor(1, "landing")
        self._pending: dict[Slot, Future[None]] = {}
        self._failed: Counter[str] = Counter()
        self._least = min(light(exposure) for exposure in book.content.order.bracket)

    @property
    def pending(self) -> list[Slot]:
        return list(self._pending)

    def take(self, slot: Slot, read_deg: float | None, shot: Shot) -> None:
        self._pending[slot] = self._thread.submit(self._land, slot, read_deg, shot)

    def collect(self, block: bool) -> None:
        """Take note of what landed; with `block` wait for a frame. Raises what went wrong with one."""
        if block and self._pending:
            wait(self._pending.values(), return_when=FIRST_COMPLETED)
        for slot in [slot for slot, future in self._pending.items() if future.done()]:
            self._pending.pop(slot).result()

    def close(self) -> None:
        """Save and judge what has come."""
        self._thread.shutdown(wait=True)

    def _land(self, slot: Slot, read_deg: float | None, shot: Shot) -> None:
        name = f"{slot.name}{frame_check.suffix(shot.data, shot.name)}"
        file = self._book.folder / name
        with atomic.path(file) as temporary:
            temporary.write_bytes(shot.data)
        others = self._book.good()
        try:
            facts, small = frame_check.inspect(file)
        except DecodeError as error:
            self._reject(slot.name, file, read_deg, str(error).removeprefix(f"{file}: "))
            return
        shortest = slot.role in _BRACKETED and light(slot.exposure) == self._least
        every = [good.facts for good in others.values()]
        reason = frame_check.fault(facts, shot.exposure, slot.flash, shortest, every, self._limits)
        alike = {
            name: good
            for name, good in others.items()
            if good.step == slot.step and slot.role in _BRACKETED and good.role in _BRACKETED
        }
        sharpest = max((good.facts.sharpness for good in alike.values()), default=0.0)
        if reason is None and frame_check.blurred(facts.sharpness, sharpest, self._limits):
            reason = "is less sharp than its neighbours; let the tripod settle"
        if reason is not None:
            self._reject(slot.name, file, read_deg, reason)
            return
        good = Good(name, slot.role, slot.angle_deg, slot.step, read_deg, shot.exposure, slot.flash, shot.name, facts)
        self._book.keep(slot, good)
        self.small[slot.name] = small
        for earlier, other in alike.items():
            if frame_check.blurred(other.facts.sharpness, facts.sharpness, self._limits):
                reason = "is less sharp than its neighbours; let the tripod settle"
                self._reject(earlier, self._book.folder / other.file, other.read_deg, reason)

    def _reject(self, slot_name: str, file: Path, read_deg: float | None, reason: str) -> None:
        aside = self._book.reject(slot_name, file, read_deg, reason)
        self._failed[slot_name] += 1
        self._log.write("check", "!", f"{slot_name}: {reason}; kept as {aside.relative_to(self._book.folder)}")
        if self._failed[slot_name] > self._tries:
            raise CaptureError(f"{slot_name} {reason} ({self._failed[slot_name]} times)")
