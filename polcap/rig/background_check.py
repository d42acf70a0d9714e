"""Saves and checks each photograph in a separate thread, while the rig takes the next ones."""

from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from polcap.errors import CaptureError, DecodeError
from polcap.image_values import Floats
from polcap.rig import retake_criteria
from polcap.rig.camera import CameraFile
from polcap.rig.capture_record import AcceptedFrame, CaptureRecord
from polcap.rig.device_log import Log
from polcap.rig.exposure_bracket import relative_exposure
from polcap.rig.shooting_plan import Slot

MOST_PENDING = 4  # photographs in memory
_BRACKET_ROLES = ("shot", "repeat")


class BackgroundCheck:
    """Thread that saves each photograph, then accepts or rejects it, in the order of taking."""

    def __init__(self, record: CaptureRecord, tries: int, log: Log) -> None:
        self.small: dict[str, Floats] = {}  # small gray pictures (h, w) of this run's accepted frames, by slot
        self._record = record
        self._tries = tries
        self._log = log
        self._thread = ThreadPoolExecutor(1, "background check")
        self._pending: dict[Slot, Future[None]] = {}
        self._rejections: Counter[str] = Counter()
        self._shortest = min(relative_exposure(exposure) for exposure in record.content.order.bracket)

    @property
    def pending(self) -> list[Slot]:
        """Frames of the plan that are photographed but not yet checked."""
        return list(self._pending)

    def submit(self, slot: Slot, read_deg: float | None, photograph: CameraFile) -> None:
        """Hand a photograph to the thread; `read_deg` is the ring's angle, None if the frame needs none."""
        self._pending[slot] = self._thread.submit(self._save_and_check, slot, read_deg, photograph)

    def collect(self, block: bool) -> None:
        """Remove the checked frames from `pending`; with `block`, first wait until one is checked.

        Raises the error of a check that could not be made, or CaptureError for a frame rejected too often.
        """
        if block and self._pending:
            wait(self._pending.values(), return_when=FIRST_COMPLETED)
        for slot in [slot for slot, future in self._pending.items() if future.done()]:
            self._pending.pop(slot).result()

    def close(self) -> None:
        """Wait until all submitted photographs are checked, then end the thread."""
        self._thread.shutdown(wait=True)

    def _save_and_check(self, slot: Slot, read_deg: float | None, photograph: CameraFile) -> None:
        """Save a photograph and accept or reject it, in the background."""
        name = f"{slot.name}{photograph.suffix}"
        file = self._record.save(name, photograph.data)
        try:
            facts, small = retake_criteria.inspect(file)
        except DecodeError as error:
            self._reject(slot.name, file, read_deg, str(error).removeprefix(f"{file}: "))
            return
        accepted = self._record.accepted()
        in_bracket = slot.role in _BRACKET_ROLES
        shortest = in_bracket and relative_exposure(slot.exposure) == self._shortest
        step = slot.step if in_bracket else None
        same_exposure = {n: f for n, f in accepted.items() if f.role in _BRACKET_ROLES and f.step == step}
        sharpest = max((frame.facts.sharpness for frame in same_exposure.values()), default=0.0)
        others = [frame.facts for frame in accepted.values()]
        reason = retake_criteria.retake_reason(facts, photograph.exposure, slot.flash, shortest, others, sharpest)
        if reason is not None:
            self._reject(slot.name, file, read_deg, reason)
            return
        place = slot.role, slot.angle_deg, slot.step
        frame = AcceptedFrame(name, *place, read_deg, photograph.exposure, slot.flash, photograph.name, facts)
        self._record.accept(slot, frame)
        self.small[slot.name] = small
        for earlier, other in same_exposure.items():  # an early frame may be the blurred one
            if retake_criteria.is_blurred(other.facts.sharpness, facts.sharpness):
                self._reject(earlier, self._record.folder / other.file, other.read_deg, retake_criteria.BLURRED)

    def _reject(self, slot_name: str, file: Path, read_deg: float | None, reason: str) -> None:
        """Move a frame to the rejected ones; it is taken again. Raises CaptureError: it was rejected too often."""
        moved = self._record.reject(slot_name, file, read_deg, reason)
        self._rejections[slot_name] += 1
        self._log.write("check", "!", f"{slot_name}: {reason}; moved to {moved}")
        if self._rejections[slot_name] > self._tries:
            count = self._rejections[slot_name]
            raise CaptureError(f"{slot_name}: rejected {count} time{'s' * (count > 1)}; last reason: {reason}")
