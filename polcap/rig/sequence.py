"""Shoots a capture: turns the polarizer, takes the frames that are missing, checks each in the background.

A rejected frame leaves its slot empty. So retaking and resuming are the same loop: take the missing frames.
"""

import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from filelock import FileLock, Timeout

from polcap.errors import PolcapError, SettingError, StorageError
from polcap.formats import folder_lock
from polcap.formats.capture import reader as captures
from polcap.rig import capture_record, device_urls, dry_run, person, preview, retake_criteria, shooting_plan
from polcap.rig.background_check import MOST_PENDING, BackgroundCheck
from polcap.rig.camera import Camera, CameraFile
from polcap.rig.capture_record import CaptureRecord, RigFile
from polcap.rig.device_log import Log
from polcap.rig.resume import open_folder
from polcap.rig.rotator import PolarizerRotator
from polcap.rig.shooting_plan import CaptureOrder, Slot

Report = Callable[[str], None]
_SPARE = 1.2  # free disk space over the size of the frames


def shoot(
    folder: Path, order: CaptureOrder, *, resume: bool = False, tries: int = 2, report: Report = lambda line: None
) -> dict[str, Any]:
    """Shoot a capture into `folder`, or with `resume` the frames that it lacks; returns a summary.

    `tries` is how often a rejected frame is retaken; `report` is called with lines of text about the progress.

    Raises CaptureError: `folder` is not empty, or a frame is rejected too often. HardwareError: a device failed. The
    frames so far stay, and `resume` continues. StorageError: the disk is full, or too small.
    """
    start = time.monotonic()
    content = open_folder(folder, resume)
    with (
        _locked(folder),
        _signals_as_ctrl_c(),
        closing(Log(folder / capture_record.LOG)) as log,
        closing(device_urls.open_camera(order.camera, log)) as camera,
    ):
        if content is None:
            bracket = order.bracket or camera.bracket(shooting_plan.uses_flash(order))
            content = RigFile(msgspec.structs.replace(order, bracket=bracket))
        content.camera = camera.model
        record = CaptureRecord(folder, content, shooting_plan.plan_slots(content.order, camera.switches_flash))
        for message in record.verify():
            report(message)
        missing = record.missing()
        _check_disk(folder, len(missing) * camera.frame_bytes)
        check = BackgroundCheck(record, tries, log)
        if missing:
            if note := shooting_plan.light_note(content.order):
                report(f"polcap: {note}")
            _check_person(missing, camera)
            _take_missing(order.rotator, record, check, camera, log, report)
        summary = _finish(record, check)
    return summary | {"taken": len(missing), "seconds": round(time.monotonic() - start, 1)}


def _take_missing(
    url: str, record: CaptureRecord, check: BackgroundCheck, camera: Camera, log: Log, report: Report
) -> None:
    """Open the rotator and take the missing frames. At the end, also after an error, the motor is released."""
    with closing(check), closing(device_urls.open_rotator(url, log)) as rotator:
        try:
            record.content.rotator = rotator.model
            log.write("polcap", "!", f"{len(record.missing())} frames to take with {rotator.model} and {camera.model}")
            record.write()
            pace = dry_run.Pace(rotator.speed_deg_s, rotator.settle_s, dry_run.overhead_s(record.content.order.camera))
            CaptureLoop(record, check, rotator, camera, pace, log, report).run()
        except PolcapError as error:
            log.write("polcap", "!", str(error))
            raise type(error)(f"{error}; the frames so far are saved, --resume continues") from error


@dataclass
class CaptureLoop:
    """Takes the missing frames of a capture, one after the other."""

    record: CaptureRecord
    check: BackgroundCheck
    rotator: PolarizerRotator
    camera: Camera
    pace: dry_run.Pace
    log: Log
    report: Report
    angle_deg: float = 0.0  # last requested
    read_deg: float | None = None  # read back after it; None: not yet
    filter_on_flash: bool = False

    def run(self) -> None:
        """Take all missing frames; a background check may ask for some again."""
        self.rotator.home()
        while True:
            self.check.collect(block=len(self.check.pending) >= MOST_PENDING)
            missing = self.record.missing(self.check.pending)
            if missing:
                slot = shooting_plan.next_slot(missing, self.angle_deg)
                turns = slot.angle_deg is not None and (self.read_deg is None or slot.angle_deg != self.angle_deg)
                if not (turns and self.rotator.by_hand and self.check.pending):
                    self._take(slot, missing)
                    continue
            elif not self.check.pending:
                return
            # wait at the end, and before a person turns the ring, who would turn it back for a rejected frame
            self.check.collect(block=True)

    def _take(self, slot: Slot, missing: list[Slot]) -> None:
        """Turn the ring if needed, take a frame, submit it to the check. Raises SettingError: exposures repeat."""
        if slot.angle_deg is not None:
            self._turn(slot, slot.angle_deg)
        total, left = len(self.record.slots), self.pace.left(missing, self.angle_deg)
        self.report(f"{slot.name:24}{total - len(missing) + 1:3}/{total}  {slot.exposure}  {left} left")
        photograph = self._photograph(slot)
        for name, frame in self.record.accepted().items():
            if slot.role == frame.role == "shot" and frame.step != slot.step and frame.exposure == photograph.exposure:
                raise SettingError(
                    f"--bracket: the camera took {slot.name} ({slot.exposure}) with {photograph.exposure}, as {name}; "
                    "give exposures that differ more"
                )
        self.check.submit(slot, None if slot.angle_deg is None else self.read_deg, photograph)

    def _turn(self, slot: Slot, angle_deg: float) -> None:
        """Turn the ring, and take shots again whose angle it missed."""
        if self.read_deg is None or angle_deg != self.angle_deg:
            self.angle_deg, self.read_deg = angle_deg, None
            read_deg = self.rotator.move(angle_deg)
            self.read_deg = round(angle_deg + (read_deg - angle_deg + 180.0) % 360.0 - 180.0, 4)  # not modulo 360
        for name in self.record.reject_other_angle(slot, self.read_deg):
            self.report(f"{name} is taken again: the ring came back to {self.read_deg:.2f}°")

    def _photograph(self, slot: Slot) -> CameraFile:
        """Take one frame. If needed, a person is asked to place the chart, or to switch the flash or its filter."""
        crossed = slot.role == "cross"
        if crossed != self.filter_on_flash and not self.camera.polarizes_flash:
            request = "put the second polarizer on the flash and turn it until the highlights vanish"
            self._ask_person(request if crossed else "take the polarizer off the flash again")
        self.filter_on_flash = crossed
        self.camera.prepare(slot.angle_deg, slot.role, slot.step)
        before = after = ""
        if slot.role == "chart":
            before, after = "put the chart in the place of the object", "remove the chart"
        elif not slot.flash and not self.camera.switches_flash:
            before, after = "switch the flash off", "switch the flash on again"
        self._ask_person(before)
        photograph = self.camera.shoot(slot.exposure, slot.flash)
        self._ask_person(after)
        return photograph

    def _ask_person(self, request: str) -> None:
        if request:
            person.ask(f"{request}, then press Enter: ", self.log)


def _finish(record: CaptureRecord, check: BackgroundCheck) -> dict[str, Any]:
    """Finish a capture: draw the preview, read the folder as `polcap process` will, return a summary."""
    middle = len(record.content.order.bracket) // 2
    accepted = record.accepted()
    shots = {name: frame for name, frame in accepted.items() if frame.role == "shot" and frame.step == middle}
    small = [
        check.small[name] if name in check.small else retake_criteria.inspect(record.folder / frame.file)[1]
        for name, frame in shots.items()
    ]
    picture = preview.write(record.folder, [record.stated_deg(frame) or 0.0 for frame in shots.values()], small)
    captures.read(record.folder)
    return {
        "folder": str(record.folder),
        "preview": str(picture),
        "rotator": record.content.rotator,
        "camera": record.content.camera,
        "angles": [
            {"asked_deg": frame.angle_deg, "read_deg": frame.read_deg, "stated_deg": record.stated_deg(frame)}
            for frame in shots.values()
        ],
        "frames": len(accepted),
        "rejected": [msgspec.to_builtins(frame) for frame in record.content.rejected],
    }


def _check_disk(folder: Path, needed: float) -> None:
    """Raise StorageError if the disk has too little room for the frames."""
    free = shutil.disk_usage(folder).free
    if free < _SPARE * needed:
        raise StorageError(
            f"{folder}: {free / 1e6:.0f} MB are free, and the frames need about {_SPARE * needed / 1e6:.0f} MB; "
            "free some space"
        )


def _check_person(missing: list[Slot], camera: Camera) -> None:
    """Fail before the first frame if a later frame needs a person and there is no terminal."""
    questions = {
        "--chart": any(slot.role == "chart" for slot in missing),
        "--ambient": not camera.switches_flash and any(not slot.flash for slot in missing),
        "--cross": not camera.polarizes_flash and any(slot.role == "cross" for slot in missing),
    }
    if any(questions.values()) and not person.at_terminal():
        options = " and ".join(option for option, needed in questions.items() if needed)
        raise SettingError(f"{options}: a person at a terminal is needed; run in a terminal, or leave it out")


def _locked(folder: Path) -> AbstractContextManager[Any]:
    """Lock the capture folder against another polcap; the system releases the lock when the process dies."""
    try:
        return folder_lock.acquire(FileLock(folder / ".lock", timeout=0))
    except Timeout as error:
        raise StorageError(f"{folder}: another polcap is shooting into it; wait until it has finished") from error


@contextmanager
def _signals_as_ctrl_c() -> Iterator[None]:
    """Make SIGTERM and SIGHUP end a run as Ctrl-C does, so that the motor stops."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = [(number, signal.signal(number, signal.default_int_handler)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)
