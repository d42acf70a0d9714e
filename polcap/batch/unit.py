"""One capture of a batch: its processing, and the record of its state.

An interrupted unit continues from its stage cache; a finished one is recognized without reading its photographs.
"""

import hashlib
import os
import socket
import subprocess
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
from msgspec.structs import replace

from polcap import resource_limits
from polcap.batch import thumbnail
from polcap.errors import InputError, PolcapError, StorageError, one_line
from polcap.formats import atomic, own_files, own_folders, text_file
from polcap.pipeline import run as pipeline
from polcap.pipeline import unchanged
from polcap.pipeline.request import Request

State = Literal["todo", "running", "interrupted", "done", "gates", "failed", "bug", "crashed"]
WORDS: dict[State, str] = {**{state: state for state in get_args(State)}, "gates": "gate failed"}  # for people
FINISHED: tuple[State, ...] = ("done", "gates")  # the asset is there
FOLDER = own_folders.BATCH  # in ROOT or --out: records, thumbnails, summary; safe to delete


@dataclass(frozen=True)
class Unit:
    """A capture of a batch: its folder, its result folder and the batch's folder."""

    name: str  # relative to the root, "/" between folders
    capture: str
    out: str
    batch_folder: str

    @property
    def slug(self) -> str:
        """File name of the capture's record; unique in the batch."""
        digest = hashlib.blake2b(os.fsencode(self.name), digest_size=4).hexdigest()  # names of folders are bytes
        return f"{atomic.safe_name(Path(self.capture).name)}-{digest}"

    @property
    def record_file(self) -> Path:
        return Path(self.batch_folder) / "records" / f"{self.slug}.json"

    @property
    def thumbnail_file(self) -> Path:
        return Path(self.batch_folder) / "thumbnails" / f"{self.slug}.jpg"


class UnitRecord(msgspec.Struct, frozen=True):
    """State and result of one capture of a batch, as stored in its JSON file."""

    name: str
    state: State = "todo"
    message: str = msgspec.field(default="", name="says")  # one line: error and remedy, or the gates that decided
    seconds: float = 0.0
    host: str = ""
    pid: int = 0
    attempts: int = 0
    verdict: str = ""  # pass, warn or fail; empty: not finished
    expected_error_deg: float | None = None  # median of the normals
    asset: str = ""  # GLB, and page below; relative to the batch's folder
    report: str = ""
    title: str = ""  # facts of the capture's catalog entry
    object_number: str = ""
    creator: str = ""
    rights: str = ""


def run(unit: Unit, request: Request, attempt: int = 1) -> UnitRecord:
    """Process one capture of a batch. Errors are not raised, but written into the record.

    Dask calls it again if a worker dies after it has finished a capture; then the finished record is returned.
    """
    if (finished := find_finished(unit, request)) is not None:
        return finished
    start = time.perf_counter()
    record = UnitRecord(unit.name, "running", host=socket.gethostname(), pid=os.getpid(), attempts=attempt)
    with own_files.opened(Path(unit.batch_folder)):
        return _run(unit, request, record, start)


def _run(unit: Unit, request: Request, record: UnitRecord, start: float) -> UnitRecord:
    """Process a capture; returns its record, with the error if there was one."""
    try:
        write_record(unit, record)
        about = _process(unit, request)
        state: State = "gates" if about["verdict"] == "fail" else "done"
        record = replace(record, state=state, message=_reason(about), **_outcome(unit, about))
    except (PolcapError, OSError) as error:
        record = replace(record, state="failed", message=one_line(error))
    except Exception as error:
        if resource_limits.is_shortfall(error):
            record = replace(record, state="failed", message="out of memory; raise --memory or run fewer workers")
        else:
            message = f"{type(error).__name__}: {one_line(error)}; {_write_traceback(unit)}"
            record = replace(record, state="bug", message=message)
    record = replace(record, seconds=round(time.perf_counter() - start, 3))
    try:
        write_record(unit, record)
    except StorageError as error:
        record = replace(record, state="failed", message=one_line(error))
    return record


def _process(unit: Unit, request: Request) -> dict[str, Any]:
    """Process a capture, remember its request and write its thumbnail; returns the content of report.json."""
    asked = request.digest(Path(unit.capture), Path(unit.out))
    capture, supplied = request.open(Path(unit.capture))
    about = pipeline.process(capture, supplied, request.config, Path(unit.out))
    assert about is not None  # only `until` leaves it out
    unchanged.remember(Path(unit.out), asked)
    thumbnail.write(unit.thumbnail_file, Path(unit.out))
    return about


def _reason(about: dict[str, Any]) -> str:
    """The gates that failed, or else those that warn, with their remedies; "" if all passed."""
    decided = [gate for gate in about["gates"] if gate["state"] == about["verdict"] != "pass"]  # the worst ones
    sentences = ([f"{gate['name']}: {gate['says']}", gate["remedy"]] for gate in decided)
    return " ".join(f"{sentence}." for pair in sentences for sentence in pair if sentence)


def _outcome(unit: Unit, about: dict[str, Any]) -> dict[str, Any]:
    """Verdict, expected error and outputs of a finished capture, for its record."""
    asset = Path(unit.out, "asset", f"{about['capture']['name']}.glb")
    outputs = {"asset": asset, "report": Path(unit.out, "report.html")}
    places = {name: Path(os.path.relpath(path, unit.batch_folder)).as_posix() for name, path in outputs.items()}
    stated = about["capture"].get("catalog", {})
    facts = {key: stated.get(key, "") for key in ("title", "object_number", "creator", "rights")}
    return {"verdict": about["verdict"], "expected_error_deg": about["expected_error_deg"], **places, **facts}


def find_finished(unit: Unit, request: Request) -> UnitRecord | None:
    """The record of a capture's earlier run, if its result still exists and nothing has changed; otherwise None."""
    record, out = read_record(unit), Path(unit.out)
    if record.state not in FINISHED or unchanged.find(out, request.digest(Path(unit.capture), out)) is None:
        return None
    return record


def read_record(unit: Unit) -> UnitRecord:
    """Read the stored record of a capture.

    The state "running" becomes "interrupted" if the process no longer exists on this machine.
    """
    try:
        record = msgspec.convert(text_file.read_json(unit.record_file), UnitRecord)
    except (OSError, ValueError):
        return UnitRecord(unit.name)
    if record.state == "running" and record.host == socket.gethostname() and not _alive(record.pid):
        return replace(record, state="interrupted")
    return record


def write_record(unit: Unit, record: UnitRecord) -> None:
    atomic.write_json(unit.record_file, record, synced=False)


def record_crash(unit: Unit, before: UnitRecord, message: str, attempt: int) -> UnitRecord:
    """Write and return a record for a capture after the process that handled it died.

    If the process finished the capture before it died, its record stays; `before` is the record before it began.
    """
    record = read_record(unit)
    if record.state in FINISHED and record != before:
        return record
    record = UnitRecord(unit.name, "crashed", message, host=socket.gethostname(), attempts=attempt)
    write_record(unit, record)
    return record


def _alive(pid: int) -> bool:
    """Whether a process of this id runs on this machine."""
    if sys.platform == "win32":  # there signal 0 is Ctrl-C
        listed = subprocess.run(["tasklist", "/fi", f"PID eq {pid}", "/fo", "csv"], capture_output=True, text=True)
        return f'"{pid}"' in listed.stdout
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it is another user's
        pass
    return True


def _write_traceback(unit: Unit) -> str:
    """Write the traceback of the current exception to a file; returns its path, or the reason why it is missing."""
    file, text = unit.record_file.with_suffix(".txt"), traceback.format_exc()
    try:
        atomic.write(file, text)
    except InputError as error:
        return f"the traceback could not be written: {one_line(error)}"
    return f"the traceback is in {file}"
