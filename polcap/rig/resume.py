"""Resumes an interrupted capture: reads its options and its record; for a new capture checks the options."""

from pathlib import Path
from typing import Any

import msgspec

from polcap.errors import CaptureError, SettingError
from polcap.formats import system_errors
from polcap.formats.capture import folder_names, layouts
from polcap.rig import capture_record
from polcap.rig.capture_record import RigFile
from polcap.rig.shooting_plan import CaptureOrder

_DEVICES = {
    "rotator": "its URL, such as elliptec:/dev/ttyUSB0, `manual` to turn the ring by hand",
    "camera": "`gphoto2` for a camera on a cable, `folder:PATH` for the folder of a tethering program",
}


def complete_order(folder: Path, options: dict[str, Any], resume: bool) -> CaptureOrder:
    """Complete the options of a capture: `options`, else those of the capture to `resume`, else defaults.

    Raises SettingError if rotator or camera is missing, or the angles make no capture; CaptureError if the capture was
    begun with other options.
    """
    stated = {name: value for name, value in options.items() if value is not None}
    begun = capture_record.load(folder) if resume else None
    if begun is not None:
        _check_same(folder, stated, msgspec.structs.asdict(begun.order))
        return msgspec.structs.replace(begun.order, **stated)
    for name in ("rotator", "camera"):
        if name not in stated and resume:
            raise SettingError(
                f"{folder} holds no capture that was begun: there is nothing to resume; correct the folder, or begin "
                "with --rotator and --camera"
            )
        if name not in stated:
            raise SettingError(f"--{name} is missing; give {_DEVICES[name]}, or `simulated` to try without")
    return CaptureOrder(**({"angles_deg": layouts.DEFAULT_DEG, "bracket": ()} | stated))


def open_folder(folder: Path, resume: bool) -> RigFile | None:
    """Create or open a capture folder: with `resume`, returns the record of an earlier run, if there is one; else None.

    Raises CaptureError: the folder holds other files, or a begun capture without `resume`.
    """
    if resume and (content := capture_record.load(folder)) is not None:
        return content
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = [path.name for path in folder_names.children(folder)]
    except OSError as error:
        raise system_errors.cannot_write(folder, error) from error
    if capture_record.NAME in names:
        raise CaptureError(f"{folder} holds a capture that was begun; continue with --resume, or choose another folder")
    if set(names) - {capture_record.LOG}:  # the log of a run that failed before its first frame
        raise CaptureError(f"{folder} is not empty ({names[0]}); choose another folder for the capture")
    return None


def _check_same(folder: Path, stated: dict[str, Any], begun: dict[str, Any]) -> None:
    """Refuse options that differ from those of the capture to resume; ports may differ."""
    for name, value in stated.items():
        device = name in ("rotator", "camera")
        if (_without_port(value) != _without_port(begun[name])) if device else value != begun[name]:
            option = "--" + name.removesuffix("_deg")
            raise CaptureError(f"{folder} was begun with another {option}; leave it out, or choose a new folder")


def _without_port(url: str) -> str:
    """Kind and settings of a device's URL."""
    head, _, query = url.partition("?")
    return f"{head.partition(':')[0]}?{query}"
