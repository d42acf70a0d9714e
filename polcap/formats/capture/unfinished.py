"""Recognizes a capture folder in which `polcap capture` was interrupted, by its record rig.json."""

from pathlib import Path
from typing import Any

import msgspec

from polcap.formats import text_file
from polcap.formats.capture import folder_names

RECORD, SESSION = "rig.json", "views.json"


class _Order(msgspec.Struct, frozen=True):
    angles_deg: tuple[float, ...] = ()
    bracket: tuple[Any, ...] = ()


class _Record(msgspec.Struct, frozen=True):
    order: _Order = _Order()
    frames: dict[str, Any] = {}


def missing_frames(folder: Path) -> int:
    """Number of planned shot frames that a capture by `polcap capture` lacks; 0 for any other folder."""
    try:
        record = msgspec.convert(text_file.read_json(folder / RECORD), _Record)
    except (OSError, ValueError):
        return 0
    angles = [f"pol{folder_names.degrees(angle)}" for angle in record.order.angles_deg]
    planned = {f"{angle}/frame_{step + 1}" for angle in angles for step in range(len(record.order.bracket))}
    return len(planned - set(record.frames))


def advice(folder: Path, missing: int) -> str:
    """Advice to finish the capture, or the session of which it is a view."""
    folder = folder.parent if (folder.parent / SESSION).exists() else folder
    frames = f"the {missing} missing frames" if missing > 1 else "the missing frame"
    return f"`polcap capture {folder} --resume` takes {frames}"
