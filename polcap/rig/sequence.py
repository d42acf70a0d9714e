"""In: an order, a rotator, a camera. Out: a capture folder, frame by frame, each checked as it lands.

The rig turns and shoots; meanwhile another thread saves and judges what came. A bad frame is kept aside and its place
is empty again, so that shooting on, shooting again and going on after a crash are one loop: take what is missing.
"""

import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
from filelock import FileLock, Timeout

from polcap.errors import CaptureError, PolcapError, SettingError, StorageError
from polcap.formats import atomic
from polcap.formats.capture import layouts
from polcap.formats.capture import reader as captures
from polcap.rig import camera_choice, frame_check, manual, plan, preview, record, rotator
from polcap.rig.camera import Camera, Exposure, Shot
from polcap.rig.landing import AHEAD, Landing
from polcap.rig.log import Log
from polcap.rig.plan import Order, Pace, Slot
from polcap.rig.record import Content, Record
from polcap.rig.rotator import Rotator

LIMITS = frame_check.Limits()
Tell = Callable[[str], None]
_SPARE = 1.2  # of the room a capture needs
_BESIDE = {record.LOG, "lock"}  # what a run leaves that was stopped before its first frame


def silent(line: str) -> None:
    """Tell nobody."""


def order(folder: Path, stated: dict[str, Any], resume: bool) -> Order:
    """What to shoot: `given` where it is not None, else with `resume` what was begun, else the default.

    Raises
    ------
    SettingError
        It makes no capture.
    """
    begun = record.load(folder) if resume else None
    wanted = {} if begun is None else msgspec.structs.asdict(begun.order)
    wanted |= {name: value for name, value in stated.items() if value is not None}
    for name in ("rotator", "camera"):
        if name not in wanted:
            if resume:
                raise SettingError(
                    f"{folder} holds no capture that was begun: there is nothing to resume; correct the folder, or "
                    "begin with --rotator and --camera"
                )
            raise SettingError(f"--{name} is missing; name one, or `simulated` to try without")
    return Order(**({"angles_deg": layouts.DEFAULT_DEG, "bracket": ()} | wanted))


def shoot(
    folder: Path,
    wanted: Order,
    *,
    resume: bool = False,
    limits: frame_check.Limits = LIMITS,
    tries: int = 2,
    tell: Tell = silent,
) -> dict[str, Any]:
    """Shoot what is `wanted` into `folder`; returns what was done.

    Raises
    ------
    CaptureError
        `folder` holds something, or with `resume` something else than what is `wanted`; or a frame stays bad.
    HardwareError
        A device fails. What was taken is kept, and `resume` goes on.
    StorageError
        The disk is full, or would be.
    """
    start = time.monotonic()
    content = _begun(folder, wanted, resume)
    with _alone(folder), _ended_politely(), _log(folder) as log, _held(wanted.camera, log) as camera:
        if content is None:
            exposures = wanted.bracket or camera.bracket(plan.names_flash(wanted))
            content = Content(_with_bracket(wanted, exposures))
        content.camera = camera.model
        book = Record(folder, content, plan.slots(content.order, camera.switches_flash))
        for line in record.verify(book):
            tell(line)
        missing = book.missing(())
        _check_room(folder, len(missing) * camera.frame_bytes)
        landing = Landing(book, limits, tries, log)
        if missing:
            if note := plan.light_note(content.order):
                tell(f"polcap: {note}")
            _check_person(missing, camera)
            _take_all(book, landing, wanted.rotator, camera, log, tell)
        return _finished(book, landing) | {"taken": len(missing), "seconds": round(time.monotonic() - start, 1)}


def _take_all(book: Record, landing: Landing, url: str, camera: Camera, log: Log, tell: Tell) -> None:
    """Hold the rotator while frames are taken; on every way out it stops and is released."""
    turner = rotator.open_rotator(url, log)
    try:
        book.content.rotator = turner.model
        book.write()
        pace = Pace(turner.speed_deg_s, turner.settle_s, plan.overhead_s(book.content.order.camera))
        _loop(book, landing, turner, camera, log, pace, tell)
    except PolcapError as error:
        log.write("polcap", "!", str(error))
        raise type(error)(f"{error}; what was taken is kept, --resume goes on") from error
    finally:
        turner.stop()
        try:
            landing.close()
        finally:
            turner.close()


def _loop(book: Record, landing: Landing, turner: Rotator, camera: Camera, log: Log, pace: Pace, tell: Tell) -> None:
    """Take what is missing until nothing is."""
    turner.home()
    at_deg, read_deg = 0.0, None  # asked for, and read back there
    filtered = False  # the flash
    while True:
        landing.collect(block=len(landing.pending) >= AHEAD)
        missing = book.missing(landing.pending)
        if not missing:
            if not landing.pending:
                return
            landing.collect(block=True)
            continue
        slot = plan.next_slot(missing, at_deg)
        if slot.angle_deg is not None:
            if read_deg is None or slot.angle_deg != at_deg:
                if landing.pending and not turner.unattended:  # nobody likes to turn back
                    landing.collect(block=True)
                    continue
                at_deg, read_deg = slot.angle_deg, None
                read_deg = _beside(turner.move(at_deg), at_deg)
            for aside in book.arrived_again(slot, read_deg):
                tell(f"{aside} is taken again: the ring came back to {read_deg:.2f}°")
        left = pace.total_s(plan.schedule([*missing], at_deg), at_deg)
        done = len(book.slots) - len(missing) + 1
        tell(f"{slot.name:24}{done:3}/{len(book.slots)}  {slot.exposure}  {left / 60:.0f}:{left % 60:02.0f} left")
        filtered = _with_filter(slot, filtered, camera, log)
        shot = _photograph(slot, camera, log)
        _check_apart(slot, shot, book)
        landing.take(slot, None if slot.angle_deg is None else read_deg, shot)


def _with_filter(slot: Slot, filtered: bool, camera: Camera, log: Log) -> bool:
    """Have a person put the flash's filter on or off, as a frame needs it; whether it is on now."""
    wanted = slot.role == "cross"
    if wanted != filtered and not camera.polarizes_flash:
        on = "put the second polarizer on the flash and turn it until the highlights vanish"
        manual.ask(f"{on if wanted else 'take the polarizer off the flash again'}, then Enter: ", log)
    return wanted


def _photograph(slot: Slot, camera: Camera, log: Log) -> Shot:
    """One frame; for some a person first does what no device can."""
    camera.prepare(slot.angle_deg, slot.role, slot.step)
    before = after = ""
    if slot.role == "chart":
        before, after = "put the chart where the object is", "take the chart away again"
    elif not slot.flash and not camera.switches_flash:
        before, after = "switch the flash off", "switch the flash on again"
    if before:
        manual.ask(f"{before}, then Enter: ", log)
    shot = camera.shoot(slot.exposure, slot.flash)
    if after:
        manual.ask(f"{after}, then Enter: ", log)
    return shot


def _beside(angle_deg: float, asked_deg: float) -> float:
    """An angle modulo 360 as the number next to the one asked for."""
    return round(asked_deg + (angle_deg - asked_deg + 180.0) % 360.0 - 180.0, 4)


def _finished(book: Record, landing: Landing) -> dict[str, Any]:
    """The preview, the capture as `polcap process` will understand it, and what was done."""
    middle = len(book.content.order.bracket) // 2
    shots = {name: good for name, good in book.good().items() if good.role == "shot" and good.step == middle}
    small = [
        landing.small[name] if name in landing.small else frame_check.inspect(book.folder / good.file)[1]
        for name, good in shots.items()
    ]
    drawn = preview.write(book.folder, [book.stated_deg(good) or 0.0 for good in shots.values()], small)
    captures.read(book.folder)
    return {
        "folder": str(book.folder),
        "preview": str(drawn),
        "rotator": book.content.rotator,
        "camera": book.content.camera,
        "angles": [
            {"asked_deg": good.angle_deg, "read_deg": good.read_deg, "stated_deg": book.stated_deg(good)}
            for good in shots.values()
        ],
        "frames": len(book.good()),
        "rejected": [msgspec.to_builtins(bad) for bad in book.content.rejected],
    }


def _begun(folder: Path, wanted: Order, resume: bool) -> Content | None:
    """What an earlier run left of the same order; None to begin. The folder is there afterwards."""
    content = record.load(folder) if resume else None
    if content is not None:
        asked = msgspec.structs.asdict(_with_bracket(wanted, content.order.bracket))
        for name, value in asked.items():
            was = getattr(content.order, name)
            here = record.without_port(value) if name in ("rotator", "camera") else value
            if here != (record.without_port(was) if name in ("rotator", "camera") else was):
                flag = {"angles_deg": "--angles", "repeat_deg": "--repeat"}.get(name, f"--{name}")
                raise CaptureError(f"{folder} was begun with another {flag}; {record.remedy(was)}, or a new folder")
        return content
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise atomic.failure(folder, error) from error
    if (folder / record.NAME).exists():
        raise CaptureError(f"{folder} holds a capture that was begun; go on with --resume, or choose another folder")
    if set(there) - _BESIDE:
        raise CaptureError(f"{folder} is not empty ({there[0]}); choose another folder for the capture")
    return None


def _with_bracket(wanted: Order, bracket: tuple[Exposure, ...]) -> Order:
    return wanted if wanted.bracket else msgspec.structs.replace(wanted, bracket=bracket)


def _check_apart(slot: Slot, shot: Shot, book: Record) -> None:
    """The dials could be set so that a bracket has as many exposures as were asked for."""
    for name, good in book.good().items():
        if slot.role == good.role == "shot" and good.step != slot.step and good.exposure == shot.exposure:
            raise SettingError(
                f"--bracket: the camera takes {slot.name} ({slot.exposure}) as {name}, with {shot.exposure}; "
                "give exposures that it can tell apart"
            )


def _check_room(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < _SPARE * needed:
        raise StorageError(
            f"{folder}: {free / 1e6:.0f} MB are free, and the frames need about {_SPARE * needed / 1e6:.0f} MB; "
            "free some space"
        )


def _check_person(missing: list[Slot], camera: Camera) -> None:
    """Fail before the first frame where somebody has to be asked later and nobody is there."""
    asks = {
        "--chart": any(slot.role == "chart" for slot in missing),
        "--ambient": not camera.switches_flash and any(not slot.flash for slot in missing),
        "--cross": not camera.polarizes_flash and any(slot.role == "cross" for slot in missing),
    }
    if any(asks.values()) and not (sys.stdin and sys.stdin.isatty()):
        named = " and ".join(name for name, needed in asks.items() if needed)
        raise SettingError(f"{named}: need a person at a terminal here; run in one, or leave it out")


@contextmanager
def _log(folder: Path) -> Iterator[Log]:
    log = Log(folder / record.LOG)
    try:
        yield log
    finally:
        log.close()
        if not (folder / record.NAME).exists() and not (folder / record.LOG).stat().st_size:  # nothing was begun
            (folder / record.LOG).unlink()


@contextmanager
def _held(name: str, log: Log) -> Iterator[Camera]:
    camera = camera_choice.open_camera(name, log)
    try:
        yield camera
    finally:
        camera.close()


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep a second polcap out of the folder; the system drops the lock when its owner dies."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise StorageError(f"{folder}: another polcap is shooting into it; wait for it") from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _ended_politely() -> Iterator[None]:
    """SIGTERM and SIGHUP end a run as Ctrl-C does, so that the motor stops."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before):
            with suppress(ValueError, TypeError):
                signal.signal(number, handler)
