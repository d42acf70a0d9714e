"""Options and record of a capture: those of the begun capture with `--resume`, else new ones."""

from pathlib import Path
from typing import Any

import msgspec

from polcap.errors import CaptureError, SettingError
from polcap.formats import atomic
from polcap.formats.capture import layouts
from polcap.rig import capture_record
from polcap.rig.capture_record import RigFile
from polcap.rig.shooting_plan import CaptureOrder


def complete_order(folder: Path, options: dict[str, Any], resume: bool) -> CaptureOrder:
    """The options that are not None; the others from the begun capture with `resume`, else by default.

    Raises SettingError if rotator or camera is missing, or the angles make no capture.
    """
    begun = capture_record.load(folder) if resume else None
    values = {"angles_deg": layouts.DEFAULT_DEG, "bracket": ()} | (msgspec.structs.asdict(begun.order) if begun else {})
    values |= {name: value for name, value in options.items() if value is not None}
    for name in ("rotator", "camera"):
        if name not in values and resume:
            raise SettingError(
                f"{folder} holds no capture that was begun: there is nothing to resume; correct the folder, or begin "
                "with --rotator and --camera"
            )
        if name not in values:
            raise SettingError(f"--{name} is missing; name one, or `simulated` to try without")
    return CaptureOrder(**values)


def open_folder(folder: Path, order: CaptureOrder, resume: bool) -> RigFile | None:
    """The record of an earlier run of the same order; None for a new capture. Creates the folder.

    Raises CaptureError if the folder holds other files, or a capture that was begun with other options.
    """
    if resume and (content := capture_record.load(folder)) is not None:
        _check_same_order(folder, order, content.order)
        return content
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise atomic.failure(folder, error) from error
    if capture_record.NAME in names:
        raise CaptureError(f"{folder} holds a capture that was begun; continue with --resume, or choose another folder")
    if set(names) - {capture_record.LOG}:  # the log of a run that failed before its first frame
        raise CaptureError(f"{folder} is not empty ({names[0]}); choose another folder for the capture")
    return None


def _check_same_order(folder: Path, order: CaptureOrder, begun: CaptureOrder) -> None:
    for name, was in msgspec.structs.asdict(begun).items():
        now = getattr(order, name)
        if name in ("rotator", "camera"):
            now, was = _without_port(now), _without_port(was)
        if now != was and not (name == "bracket" and not now):  # by default, the camera's own bracket
            option = "--" + name.removesuffix("_deg")
            raise CaptureError(f"{folder} was begun with another {option}; leave it out, or choose a new folder")


def _without_port(url: str) -> str:
    """A device's URL without its port, which may differ after the cable was plugged in again."""
    head, _, query = url.partition("?")
    return f"{head.partition(':')[0]}?{query}"
