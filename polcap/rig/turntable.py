"""Shoots an object from all sides: a turntable turns object and board, and each view is a capture of its own.

`views.json` in the session's folder records the turntable and the finished views, so that an interrupted session
continues with the view that was begun.
"""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from polcap.errors import CaptureError, SettingError
from polcap.formats import atomic
from polcap.formats.capture import folder_names, unfinished
from polcap.rig import capture_record, device_urls, sequence
from polcap.rig.device_log import Log
from polcap.rig.shooting_plan import CaptureOrder

NAME, LOG = unfinished.SESSION, "turntable.log"


class SessionFile(msgspec.Struct):
    """Content of views.json."""

    views: Annotated[int, Meta(ge=3)]
    turntable: str  # URL
    done: list[str] = []  # names of the finished views


def open_session(folder: Path, views: int | None, turntable: str | None, resume: bool) -> SessionFile | None:
    """The session of `--views` and `--turntable`, or with `resume` the one begun; None for a single capture.

    Raises SettingError: one of the two is missing. CaptureError: the folder holds another session, other files, or
    with `resume` no session that was begun.
    """
    file = folder / NAME
    if resume and file.exists():
        begun = capture_record.read(file, SessionFile)
        if views not in (None, begun.views):
            raise CaptureError(f"{folder} was begun with --views {begun.views}; leave it out, or choose a new folder")
        return msgspec.structs.replace(begun, turntable=turntable or begun.turntable)
    if views is None and turntable is None:
        return None
    if views is None or turntable is None:
        raise SettingError("--views and --turntable belong together; give both, such as --views 12 --turntable manual")
    if resume:
        raise CaptureError(f"{folder} holds no session that was begun: there is nothing to resume; leave out --resume")
    if folder.exists() and any(path.name != LOG for path in folder_names.children(folder)):
        raise CaptureError(f"{folder} is not empty; continue with --resume, or choose another folder")
    return SessionFile(views, turntable)


def first_view(folder: Path) -> Path:
    """Folder of the first view; its record states the options of all views."""
    return folder / folder_names.view_name(0)


def shoot(
    folder: Path,
    session: SessionFile,
    order: CaptureOrder,
    *,
    tries: int = 2,
    report: sequence.Report = lambda line: None,
    finished: Callable[[Path], None] = lambda view: None,
) -> list[dict[str, Any]]:
    """Shoot the views of a session that are missing; returns the summary of each.

    `finished` is called with the folder of each view before the table turns on.

    Raises CaptureError, HardwareError, StorageError: as for one capture, or of the turntable. The frames so far stay,
    and `--resume` continues.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_ports(session.turntable, order.rotator)
    summaries = []
    with (
        closing(Log(folder / LOG)) as log,
        closing(device_urls.open_rotator(session.turntable, log, "turntable with the board")) as table,
    ):
        atomic.write_json(folder / NAME, session)
        for k in range(session.views):
            view = folder / folder_names.view_name(k)
            if view.name in session.done:
                continue
            table.move(360.0 * k / session.views)
            report(f"{view.name} of {session.views}")
            is_begun = (view / capture_record.NAME).exists()
            view_order = order if k == 0 else msgspec.structs.replace(order, chart=False)  # one chart is enough
            summaries.append(sequence.shoot(view, view_order, resume=is_begun, tries=tries, report=report))
            finished(view)
            session.done.append(view.name)
            atomic.write_json(folder / NAME, session)
    return summaries


def _check_ports(turntable: str, rotator: str) -> None:
    """Raise SettingError where both motors are on one port."""
    table, ring = (url.partition("?")[0].partition(":")[2] for url in (turntable, rotator))
    if table and table == ring:
        raise SettingError(f"--turntable and --rotator are both on {table}; connect each motor to a port of its own")
