"""Detects that a result folder is already up to date: same options, same files, nothing changed since.

It compares sizes and times, as build tools do, before anything heavy is imported. So a run that has nothing to do takes
milliseconds. If anything differs, the keys of the stage cache decide which stages are computed again.
"""

import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

from polcap.formats import atomic, own_files, own_folders, text_file
from polcap.formats.export import provenance

_FILE = "unchanged.json"
_PARTS = ("maps", "asset", "report.html", "report.json", "color.toml")  # of a result, besides stages in work/
_PACKAGE = Path(__file__).parents[1]
_SETTLED_NS = 3_000_000_000  # some file systems have clocks of 2 s steps; within one a file may change unseen
Stat = list[int]  # size, time of the content, time of the last change of any kind, inode


class Finished(NamedTuple):
    """An earlier run that is still up to date: its printed table and its report."""

    table: str  # of the capture, as it was understood
    report: dict[str, Any]


def request(options: Any, capture: Path, out: Path, files: Iterable[Path] = ()) -> str | None:
    """Digest of a run's request: options, program, and size and time of photographs and other input files.

    `options` is plain data. The user's calibrations count as input files. None if a file is unreadable or just changed.
    """
    try:
        photographs = _stats(capture, os.path.realpath(out), own_folders.OURS)
        files = (*files, *own_folders.toml_files(own_folders.calibrations()))
        others = {os.path.abspath(file): _stat(file) for file in files}
    except OSError:
        return None
    newest = max((stat[1] for stat in [*photographs.values(), *others.values()]), default=0)
    if newest > time.time_ns() - _SETTLED_NS:
        return None
    return _digest([options, os.path.realpath(capture), os.path.realpath(out), photographs, others, _program()])


def request_of_run(stated: Any) -> str:
    """Digest of a run's request from plain data that determine its inputs and settings, and of the program."""
    return _digest([stated, _program()])


def find(out: Path, asked: str | None) -> Finished | None:
    """The earlier run with this request digest, if nothing in its result folder has changed since; else None."""
    try:
        record = text_file.read_json(out / "work" / _FILE)
        if asked is None or record["request"] != asked or not _holds(record["result"], out):
            return None
        if any(_stat(file) != stat for file, stat in record["files"].items()):
            return None
        return Finished(str(record["table"]), text_file.read_json(out / "report.json"))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def remember(out: Path, asked: str | None, table: str = "", files: Iterable[Path] = ()) -> None:
    """Record the request digest that the result folder now answers; does nothing if it is None.

    `files` are further inputs, which were not known when the request was made.
    """
    if asked is not None:
        stats = {os.path.abspath(file): _stat(file) for file in files}
        content = {"request": asked, "table": table, "files": stats, "result": _result(out)}
        with own_files.opened(out):
            atomic.write_json(out / "work" / _FILE, content, synced=False)


@contextmanager
def preserved(out: Path) -> Iterator[None]:
    """Context manager: if a locked result is up to date, it still counts as such after polcap has changed its files."""
    record: dict[str, Any] = {}
    with suppress(OSError, ValueError, TypeError, KeyError):
        record = text_file.read_json(out / "work" / _FILE)
        if not _holds(record["result"], out):
            record = {}
    yield
    if record:
        with own_files.opened(out):
            atomic.write_json(out / "work" / _FILE, {**record, "result": _result(out)}, synced=False)


@cache
def _program() -> str:
    """Digest of the program: sizes and times of its files, and versions of the packages that affect pixels."""
    return _digest([sys.version, provenance.versions(), _stats(_PACKAGE), _stats(_PACKAGE.parent / "calib")])


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, default=str)
    return blake2b(text.encode(errors="surrogateescape"), digest_size=16).hexdigest()


def _result(out: Path) -> dict[str, Stat]:
    """Stats of the files that a run writes; those of `show` and of comparisons are left out."""
    return {name: stat for name, stat in _stats(out).items() if _is_of_run(Path(name).parts)}


def _is_of_run(parts: tuple[str, ...]) -> bool:
    """Whether a run writes the file with these parts of its path: of work/, files of stages and run.json."""
    return parts[0] in _PARTS or (parts[0] == "work" and (len(parts) > 2 or parts[1] == "run.json"))


def _holds(expected: dict[str, Stat], out: Path) -> bool:
    """Whether all files of a result still have the `expected` stats; files that others added do not matter."""
    found = _result(out)
    return all(found.get(name) == stat for name, stat in expected.items())


def _stats(folder: Path, result: str = "", ignored: tuple[str, ...] = (own_folders.BATCH,)) -> dict[str, Stat]:
    """Stats of every file below a folder, but for those in the folder of path `result` or in one named in `ignored`.

    Raises OSError: a folder is a link, which is not followed.
    """
    found: dict[str, Stat] = {}
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name not in ("__pycache__", *ignored)]
        folders[:] = [name for name in folders if os.path.realpath(os.path.join(place, name)) != result]
        if any(os.path.islink(os.path.join(place, name)) for name in folders):
            raise OSError(f"{place}: a folder is a link")
        paths = [os.path.join(place, name) for name in files]
        found |= {os.path.relpath(path, folder): _stat(path) for path in paths}
    return found


def _stat(file: str | Path) -> Stat:
    status = os.stat(file)
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
