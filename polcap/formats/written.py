"""In: the files of a result, and what each is made from. Out: only those that do not stand already are made again.

A file stands where an earlier run made it of the same, by the same program, and its size and time are those of then.
What it is made from is told by keys of results or digests of pixels: a changed setting costs what follows from it.
"""

import json
import os
from collections.abc import Callable, Sequence
from hashlib import blake2b, sha256
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap.formats import atomic, text_file

_FILE = "written.json"


class _Known(msgspec.Struct, frozen=True):
    """What is read of work/written.json."""

    files: dict[str, list[int]]
    made_from: dict[str, str]


class Written:
    """work/written.json of a result folder: each file's size and time, and what it was made from.

    Parameters
    ----------
    out
        The result folder.
    program
        Digest of the program that writes: what another wrote does not stand.
    anew
        Nothing stands, whatever was made before.
    """

    def __init__(self, out: Path, program: str = "", anew: bool = False) -> None:
        self._out, self._program = out, program
        self._before = _Known({}, {}) if anew else _read(out / "work" / _FILE)
        self._made: dict[str, str] = {}

    def make(self, file: Path, made_from: Any, write: Callable[[], object]) -> None:
        """Have `write` make `file`, unless it stands.

        Parameters
        ----------
        file
            In the result folder.
        made_from
            Plain JSON data and arrays; equal where `write` would write the same bytes.
        write
            Makes `file`.
        """
        name, mark = self._name(file), digest([self._program, made_from])
        if not self._is(name, mark, file):
            write()
        self._made[name] = mark

    def stands(self, file: Path, made_from: Any) -> bool:
        """The file is as the last run left it, which made it from this; it is taken over then."""
        name, mark = self._name(file), digest([self._program, made_from])
        if not self._is(name, mark, file):
            return False
        self._made[name] = mark
        return True

    def note(self, file: Path, made_from: Any) -> None:
        """Write down what a file that `make` does not decide on was made from."""
        self._made[self._name(file)] = digest([self._program, made_from])

    def _is(self, name: str, mark: str, file: Path) -> bool:
        return self._before.made_from.get(name) == mark and self.left(file)

    def _name(self, file: Path) -> str:
        return file.relative_to(self._out).as_posix()

    def stand(self, files: Sequence[Path], made_from: Any) -> bool:
        """Every file is as the last run left it, and it noted the first as made from this; they are taken over then."""
        names = [file.relative_to(self._out).as_posix() for file in files]
        if self._before.made_from.get(names[0]) != digest([self._program, made_from]):
            return False
        if not all(map(self.left, files)):
            return False
        self._made |= {name: mark for name in names if (mark := self._before.made_from.get(name)) is not None}
        return True

    def left(self, file: Path) -> bool:
        """The file is as the last run left it."""
        return self._before.files.get(self._name(file)) == _stat(file)

    def untouched(self) -> bool:
        """Every file of the result is as the last run left it, none is missing and none has come."""
        return bool(self._before.files) and self._before.files == _files(self._out)

    def remember(self) -> None:
        """Write down what the next run finds.

        Raises
        ------
        StorageError
            The folder cannot be written.
        """
        known = {"files": _files(self._out), "made_from": self._made}
        with atomic.path(self._out / "work" / _FILE, synced=False) as temporary:
            temporary.write_text(json.dumps(known) + "\n", encoding="utf-8")


def digest(value: Any) -> str:
    """Of nested plain data and arrays."""
    return blake2b(json.dumps(value, sort_keys=True, default=_plain).encode(), digest_size=16).hexdigest()


def _plain(value: Any) -> list[Any]:
    """An array, as JSON."""
    solid = np.ascontiguousarray(value)
    summed = sha256(solid.data.cast("B") if solid.size else b"")
    return [str(solid.dtype), list(solid.shape), summed.hexdigest()]


def _read(file: Path) -> _Known:
    try:
        return msgspec.convert(text_file.read_json(file), _Known)
    except (OSError, ValueError):
        return _Known({}, {})


def _files(out: Path) -> dict[str, list[int]]:
    """Size and time of every file of a result but the cache."""
    found = {}
    for root, folders, files in os.walk(out):
        if Path(root) == out:
            folders[:] = [name for name in folders if name != "work"]
        for name in files:
            file = Path(root) / name
            found[file.relative_to(out).as_posix()] = _stat(file)
    return found


def _stat(file: Path) -> list[int]:
    """Nothing where there is no file."""
    try:
        about = file.stat()
    except OSError:
        return []
    return [about.st_size, about.st_mtime_ns]
