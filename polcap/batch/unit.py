"""One capture of a batch: what decides its result, and the work itself, which never raises.

A unit is idempotent: a unit that was cut off goes on from the stages in its cache, and one that is done is known
without opening a photograph.
"""

import hashlib
import json
import os
import socket
import sys
import time
import traceback
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec

from polcap.errors import InputError, PolcapError, StorageError
from polcap.formats import atomic, own_folders
from polcap.images import ChartRequest, Network
from polcap.pipeline import unchanged
from polcap.pipeline.cache import fingerprint

State = Literal["todo", "running", "interrupted", "done", "gates", "failed", "bug", "crashed"]
FINISHED: tuple[State, ...] = ("done", "gates")  # the asset is there
_SYNCHRONIZE, _WAIT_TIMEOUT = 0x00100000, 0x102  # Windows: winnt.h, winbase.h
FOLDER = own_folders.BATCH  # in ROOT or in --out: records, thumbnails, summary, job files; safe to delete


@dataclass(frozen=True)
class Unit:
    """A capture and where its result goes."""

    name: str  # relative to the root, "/" between folders
    capture: str
    out: str
    desk: str  # the batch's own folder

    @property
    def slug(self) -> str:
        """A file name of its own for every capture."""
        digest = hashlib.blake2b(os.fsencode(self.name), digest_size=4).hexdigest()  # names of folders are bytes
        return f"{atomic.safe_name(Path(self.capture).name)}-{digest}"

    @property
    def record_file(self) -> Path:
        return Path(self.desk) / "records" / f"{self.slug}.json"

    @property
    def thumbnail_file(self) -> Path:
        return Path(self.desk) / "thumbnails" / f"{self.slug}.jpg"


@dataclass(frozen=True)
class Order:
    """What is to be done with every capture; the same for all of a batch."""

    settings: dict[str, Any]  # of polcap.config.Config, as plain data
    chart: ChartRequest = field(default_factory=lambda: ChartRequest("auto"))
    estimator: Literal["network", "analytic"] | None = None
    model: str | None = None
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    threads: int = 0
    memory_gb: float = 0.0
    angles_deg: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Record:
    """What became of a unit."""

    name: str
    state: State = "todo"
    says: str = ""  # one line: the error with its remedy, or the failed gates
    seconds: float = 0.0
    host: str = ""
    pid: int = 0
    attempts: int = 0


def run(unit: Unit, order: Order, attempt: int = 1) -> Record:
    """Process one capture; whatever goes wrong is in the record."""
    start = time.perf_counter()
    record = Record(unit.name, "running", "", 0.0, socket.gethostname(), os.getpid(), attempt)
    try:
        write_record(unit, record)
        about = _process(unit, order)
        failed = [gate for gate in about["gates"] if gate["state"] == "fail"]
        says = " ".join(f"{gate['name']}: {gate['says']}. {gate['remedy']}." for gate in failed)
        record = replace(record, state="gates" if failed else "done", says=says)
    except PolcapError as error:
        record = replace(record, state="failed", says=_line(error))
    except OSError as error:
        record = replace(record, state="failed", says=_line(error))
    except MemoryError:
        record = replace(record, state="failed", says="out of memory; raise --memory or run fewer workers")
    except Exception as error:
        says = f"{type(error).__name__}: {_line(error)}; its traceback stands in {unit.record_file.with_suffix('.txt')}"
        record = replace(record, state="bug", says=says)
        _write_traceback(unit)
    record = replace(record, seconds=round(time.perf_counter() - start, 3))
    try:
        write_record(unit, record)
    except StorageError as error:
        record = replace(record, state="failed", says=_line(error))
    return record


def _process(unit: Unit, order: Order) -> dict[str, Any]:
    from polcap.batch import thumbnail
    from polcap.config import Config
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import run as pipeline
    from polcap.pipeline.path import UserInput

    config = msgspec.convert(order.settings, Config)
    supplied = UserInput(
        chart=order.chart,
        network=_network(order.estimator, order.model, order.device, order.threads),
        mask_network=_mask_network(order.threads),
    )
    asked = request(unit, order)
    found = captures.read(unit.capture, order.angles_deg)
    about = pipeline.process(found, supplied, config, Path(unit.out))
    assert about is not None  # only `until` leaves it out
    unchanged.remember(Path(unit.out), asked)
    thumbnail.write(unit.thumbnail_file, Path(unit.out))
    return about


@lru_cache(maxsize=1)
def _network(estimator: Any, model: str | None, device: Any, threads: int) -> Network | None:
    """Loaded once for all captures of a process."""
    from polcap.pipeline import models

    return models.load_network(estimator, None if model is None else Path(model), device, threads)


@lru_cache(maxsize=1)
def _mask_network(threads: int) -> Network | None:
    """Loaded once, too."""
    from polcap.pipeline import models

    return models.load_mask_network(threads)


def request(unit: Unit, order: Order) -> str | None:
    """The request that a unit is, as `pipeline/unchanged.py` compares it."""
    options = {**asdict(replace(order, threads=0, memory_gb=0.0)), "chart": fingerprint(order.chart)}
    files = [] if order.model is None else [Path(order.model)]
    return unchanged.request(options, Path(unit.capture), Path(unit.out), files)


def finished(unit: Unit, order: Order) -> Record | None:
    """The record of an earlier run, if its result is there and nothing has changed since; else None."""
    record = read_record(unit)
    if record.state not in FINISHED or unchanged.find(Path(unit.out), request(unit, order)) is None:
        return None
    return record


def read_record(unit: Unit) -> Record:
    """What is known of a unit; a running one whose process is gone from this host was interrupted."""
    try:
        record = msgspec.convert(json.loads(unit.record_file.read_text(encoding="utf-8")), Record)
    except (OSError, ValueError, msgspec.ValidationError):
        return Record(unit.name)
    if record.state == "running" and record.host == socket.gethostname() and not _alive(record.pid):
        return replace(record, state="interrupted")
    return record


def write_record(unit: Unit, record: Record) -> None:
    with atomic.path(unit.record_file, synced=False) as temporary:
        temporary.write_text(json.dumps(asdict(record)) + "\n", encoding="utf-8")


def crashed(unit: Unit, why: str, attempt: int) -> Record:
    """The record of a unit that took its process down, written for it."""
    record = Record(unit.name, "crashed", why, 0.0, socket.gethostname(), 0, attempt)
    write_record(unit, record)
    return record


def _alive(pid: int) -> bool:
    if sys.platform == "win32":  # there signal 0 is Ctrl-C
        import ctypes

        kernel = ctypes.windll.kernel32
        handle = kernel.OpenProcess(_SYNCHRONIZE, False, pid)
        runs = bool(handle) and kernel.WaitForSingleObject(handle, 0) == _WAIT_TIMEOUT
        kernel.CloseHandle(handle)
        return runs
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _write_traceback(unit: Unit) -> None:
    text = traceback.format_exc()
    try:
        with atomic.path(unit.record_file.with_suffix(".txt")) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except InputError:
        pass  # the record says what happened; the disk may be the reason


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
