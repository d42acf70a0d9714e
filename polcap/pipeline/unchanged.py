"""In: what `polcap process` is asked. Out: whether the same was asked before of the same files, and what it answered.

A look at sizes and times, as build tools take one, before anything is imported or hashed; where a file, an option or
the program differs in any of them the keys of `store.py` decide. So a run that has nothing to do costs milliseconds.
"""

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

from polcap.formats import atomic, file_stat, text_file
from polcap.formats.export import provenance

_FILE = "unchanged.json"
_OF_A_RUN = ("lock", "owner", _FILE)  # in work/: they differ from run to run
_PACKAGE = Path(__file__).parents[1]
Stats = dict[str, file_stat.Stat]


class Finished(NamedTuple):
    """A finished run."""

    table: str  # what was understood of the capture
    stages: tuple[str, ...]  # that lie in the cache
    report: dict[str, Any]


class InDoubt(Exception):
    """Sizes and times do not tell."""


def fingerprint(asked: Mapping[str, Any], capture: Path, out: Path, given: Iterable[Path]) -> str | None:
    """Digest of a request: options, program, photographs and the `given` files by size and time; None if in doubt."""
    try:
        photographs, files = _folder(capture, out), {str(file.absolute()): file_stat.of(file) for file in given}
        newest = max((stat[1] for stat in [*photographs.values(), *files.values()]), default=0)
        if not file_stat.is_settled(newest):
            return None
        places = [os.path.realpath(capture), os.path.realpath(out)]
        return _digest([dict(asked), places, photographs, files, program()])
    except (OSError, InDoubt):
        return None


@cache
def program() -> str:
    """Digest of the program by its files' sizes and times, and of the packages that decide on pixels.

    Raises
    ------
    InDoubt
        A folder of it is a link.
    OSError
        It cannot be listed.
    """
    return _digest([sys.version, provenance.versions(), _folder(_PACKAGE), _folder(_PACKAGE.parent / "calib")])


def known_program() -> str | None:
    """The same; None where it is in doubt."""
    try:
        return program()
    except (OSError, InDoubt):
        return None


def find(out: Path, request: str | None) -> Finished | None:
    """The run that answered this very request, if all that it wrote stands as it left it."""
    if request is None:
        return None
    try:
        known = text_file.read_json(out / "work" / _FILE)
        if known["request"] != request or known["result"] != _result(out):
            return None
        return Finished(str(known["table"]), tuple(known["stages"]), text_file.read_json(out / "report.json"))
    except (OSError, ValueError, TypeError, KeyError, InDoubt):
        return None


def remember(out: Path, request: str | None, table: str, stages: Iterable[str]) -> None:
    """What `find` finds after this run; nothing where the request is in doubt.

    Raises
    ------
    StorageError
        The result folder cannot be written.
    """
    if request is None:
        return
    known = {"request": request, "table": table, "stages": list(stages), "result": _result(out)}
    with atomic.path(out / "work" / _FILE, synced=False) as temporary:
        temporary.write_text(json.dumps(known) + "\n", encoding="utf-8")


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, default=str)
    return blake2b(text.encode(errors="surrogateescape"), digest_size=16).hexdigest()


def _result(out: Path) -> Stats:
    found = _folder(out)
    return {name: stat for name, stat in found.items() if name not in [os.path.join("work", one) for one in _OF_A_RUN]}


def _folder(folder: Path, but: Path | None = None) -> Stats:
    """Size and times of every file below a folder, without what lies in `but`; empty where there is none."""
    aside = None if but is None else os.path.realpath(but)
    return {os.path.relpath(file, folder): file_stat.of(file) for file in _files(str(folder), aside)}


def _files(folder: str, aside: str | None) -> Iterator[str]:
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name != "__pycache__" and not _same(os.path.join(place, name), aside)]
        if any(os.path.islink(os.path.join(place, name)) for name in folders):
            raise InDoubt  # what a link leads to is not walked
        yield from (os.path.join(place, name) for name in files)


def _same(place: str, aside: str | None) -> bool:
    return aside is not None and os.path.realpath(place) == aside
