"""Resume after any failure: the options of the begun capture, and the files that an interrupted run left."""

from pathlib import Path
from typing import Any

import msgspec

from polcap.errors import CaptureError, SettingError
from polcap.formats import atomic
from polcap.formats.capture import layouts
from polcap.formats.raw import file_bytes
from polcap.rig import capture_record
from polcap.rig.capture_record import CaptureRecord, RigFile
from polcap.rig.shooting_plan import CaptureOrder

_LEFT_BEFORE_FIRST_FRAME = {capture_record.LOG}  # by a run that failed early


def complete_order(folder: Path, options: dict[str, Any], resume: bool) -> CaptureOrder:
    """The options that are not None; the others from the begun capture with `resume`, else by default.

    Raises SettingError if rotator or camera is missing, or the angles make no capture.
    """
    begun = capture_record.load(folder) if resume else None
    values = {} if begun is None else msgspec.structs.asdict(begun.order)
    values |= {name: value for name, value in options.items() if value is not None}
    for name in ("rotator", "camera"):
        if name not in values and resume:
            raise SettingError(
                f"{folder} holds no capture that was begun: there is nothing to resume; correct the folder, or begin "
                "with --rotator and --camera"
            )
        if name not in values:
            raise SettingError(f"--{name} is missing; name one, or `simulated` to try without")
    return CaptureOrder(**({"angles_deg": layouts.DEFAULT_DEG, "bracket": ()} | values))


def open_folder(folder: Path, order: CaptureOrder, resume: bool) -> RigFile | None:
    """The record of an earlier run of the same order; None for a new capture. Creates the folder.

    Raises CaptureError if the folder holds other files, or a capture that was begun with other options.
    """
    content = capture_record.load(folder) if resume else None
    if content is not None:
        _check_same_order(folder, order, content.order)
        return content
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise atomic.failure(folder, error) from error
    if capture_record.NAME in names:
        raise CaptureError(f"{folder} holds a capture that was begun; continue with --resume, or choose another folder")
    if set(names) - _LEFT_BEFORE_FIRST_FRAME:
        raise CaptureError(f"{folder} is not empty ({names[0]}); choose another folder for the capture")
    return None


def _check_same_order(folder: Path, order: CaptureOrder, begun: CaptureOrder) -> None:
    for name, was in msgspec.structs.asdict(begun).items():
        now = getattr(order, name)
        if name == "bracket" and not now:  # by default, the camera's own
            continue
        if name in ("rotator", "camera") and _without_port(now) == _without_port(was):
            continue
        if now != was:
            option = {"angles_deg": "--angles", "repeat_deg": "--repeat"}.get(name, f"--{name}")
            raise CaptureError(f"{folder} was begun with another {option}; {_how_to_repeat(was)}, or a new folder")


def _without_port(url: str) -> str:
    """A device's URL without its port, which may differ after the cable was plugged in again."""
    head, _, query = url.partition("?")
    return f"{head.partition(':')[0]}?{query}"


def _how_to_repeat(value: Any) -> str:
    """How to give an option the value that it had."""
    if isinstance(value, bool):
        return "give it" if value else "leave it out"
    if isinstance(value, tuple):
        listed = ", ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in value)
        return f"give {listed}" if listed else "leave it out"
    return f"give {value}"


def verify(record: CaptureRecord) -> list[str]:
    """Reject frames that have changed, and files that no record names; returns a message for each."""
    messages = []
    for name, frame in list(record.content.frames.items()):
        file = record.folder / frame.file
        if not file.is_file():
            del record.content.frames[name]
            messages.append(f"{frame.file}: the file is missing; the frame is taken again")
        elif file_bytes.digest(file.read_bytes()) != frame.facts.digest:
            record.reject(name, file, frame.read_deg, "changed since it was taken")
            messages.append(f"{frame.file}: changed since it was taken; the frame is taken again")
    recorded = {frame.file for frame in record.content.frames.values()}
    for slot in record.slots:
        for file in sorted((record.folder / slot.name).parent.glob(f"{Path(slot.name).name}.*")):
            name = file.relative_to(record.folder).as_posix()
            if name not in recorded:
                record.reject(slot.name, file, None, "left by an interrupted run before it was checked")
                messages.append(f"{name}: was not checked before the interruption; the frame is taken again")
    for temporary in record.folder.rglob(".*.part*"):
        atomic.discard(temporary)
    return messages
