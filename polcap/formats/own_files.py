"""Files that polcap wrote into a folder, such as a result: it replaces and removes only these, unless edited.

`polcap-files.txt` in the folder lists them after its first line, relative to the folder: a line for each content that a
file had, with its path, a tab and the content's digest; for stages and JSON files the path alone. A line is written
before the file gets its name, so a killed run leaves no file without one. Links inside the folder are never followed.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from hashlib import blake2b, file_digest
from pathlib import Path

from polcap.errors import StorageError
from polcap.formats import system_errors, text_file

RECORD = "polcap-files.txt"
_FIRST_LINE = b"# polcap wrote these files; it replaces and removes only these.\n"
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)  # flag with which `os.open` refuses a link
_opened: dict[str, "OwnFiles"] = {}  # by absolute path of the folder; polcap writes into these now


class OwnFiles:
    """The recorded files of one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(os.path.abspath(folder))
        self._digests: dict[str, set[str]] = defaultdict(set)  # of the contents that a file had, by name
        self._read()

    def owns(self, file: Path) -> bool:
        """Whether polcap wrote this file; another process may have recorded it meanwhile."""
        name = self._name(file)
        if name not in self._digests:
            self._read()
        return name in self._digests

    def check(self, file: Path) -> None:
        """Raise a StorageError if polcap must not replace `file`.

        It exists and is not polcap's, it is a folder, somebody has edited it, or it or a folder above it is a link.
        """
        place = self.folder
        for part in Path(self._name(file)).parts:
            place /= part
            if place.is_symlink():
                raise StorageError(f"cannot write {file}: {place} is a link; remove it, or choose another --out")
        if place.is_dir() or (os.path.lexists(place) and not self.owns(file)):
            kind = "folder" if place.is_dir() else "file"
            raise StorageError(f"cannot write {file}: polcap did not write the {kind} that is there; move it away")
        if self._is_edited(place):
            raise StorageError(
                f"cannot write {file}: it was edited after polcap wrote it; move it away, or choose another --out"
            )

    def record(self, files: Mapping[Path, Path]) -> None:
        """Add files to the record, by their final names; the values are the complete files. Raises OSError."""
        digests = {self._name(final): _digest(file) for final, file in files.items() if self._is_for_people(final)}
        names = [name for name in map(self._name, files) if name not in self._digests and name not in digests]
        lines = [f"{name}\t{digest}" for name, digest in digests.items() if digest not in self._digests.get(name, ())]
        if lines := [*names, *lines]:
            handle = os.open(self.folder / RECORD, os.O_APPEND | os.O_CREAT | os.O_RDWR | _NO_LINK, 0o666)
            with os.fdopen(handle, "r+b") as record:
                if os.fstat(handle).st_size == 0:  # somebody removed the record
                    record.write(_FIRST_LINE)
                elif record.seek(-1, os.SEEK_END) and record.read(1) != b"\n":  # a full disk cut the last line
                    record.write(b"\n")
                record.write("".join(f"{line}\n" for line in lines).encode(errors="surrogateescape"))
            self._add(lines)

    def below(self, folder: Path) -> list[Path]:
        """The recorded files below a folder that exist and to which no link leads, by name."""
        self._read()
        found = [self.folder / name for name in sorted(self._digests) if name.startswith(f"{self._name(folder)}/")]
        return [file for file in found if file.is_file() and not self._is_linked(file)]

    def remove(self, file: Path) -> None:
        """Remove a file if polcap wrote it, nobody has edited it and no link leads to it. Raises OSError."""
        if self.owns(file) and not self._is_linked(file) and not self._is_edited(file):
            Path(os.path.abspath(file)).unlink(missing_ok=True)

    def _is_edited(self, file: Path) -> bool:
        """Whether a file has a content that polcap has not recorded, or cannot be read."""
        name = self._name(file)
        if not self._digests.get(name) or not file.is_file():
            return False
        try:
            content = _digest(file)
        except OSError:
            return True
        if content not in self._digests[name]:
            self._read()  # another process may have written it
        return content not in self._digests[name]

    def _is_for_people(self, file: Path) -> bool:
        """Whether somebody may edit a file: it is no stage's, and no JSON file, which `export` adds to."""
        return file.suffix not in (".json", ".jsonl") and not self._name(file).startswith("work/")

    def _is_linked(self, file: Path) -> bool:
        parts = Path(self._name(file)).parts
        return any(self.folder.joinpath(*parts[: k + 1]).is_symlink() for k in range(len(parts)))

    def _name(self, file: Path) -> str:
        return Path(os.path.abspath(file)).relative_to(self.folder).as_posix()

    def _read(self) -> None:
        with suppress(OSError, ValueError):  # there is none yet
            content = text_file.read_bytes(self.folder / RECORD, text_file.TEXT_BYTES)
            self._add(content.decode(errors="surrogateescape").splitlines()[1:])

    def _add(self, lines: Iterable[str]) -> None:
        for line in lines:
            name, _, digest = line.partition("\t")
            self._digests[name].update([digest] * bool(digest))


def _digest(file: Path) -> str:
    with file.open("rb") as content:
        return file_digest(content, partial(blake2b, digest_size=16)).hexdigest()


def is_claimed(folder: Path) -> bool:
    """Whether a folder has a record of polcap's files."""
    record = folder / RECORD
    try:
        return not record.is_symlink() and text_file.read_bytes(record, text_file.TEXT_BYTES).startswith(_FIRST_LINE)
    except (OSError, ValueError):
        return False


def _is_cut(record: Path) -> bool:
    """Whether a record ends within its first line, or before it, as after a kill or on a full disk."""
    try:
        return _FIRST_LINE.startswith(text_file.read_bytes(record, text_file.TEXT_BYTES))
    except (OSError, ValueError):
        return False


def wrote(folder: Path, file: Path) -> bool:
    """Whether polcap wrote a file into a folder of its own."""
    inside = Path(os.path.abspath(file)).is_relative_to(os.path.abspath(folder))
    return inside and is_claimed(folder) and OwnFiles(folder).owns(file)


def claim(folder: Path, uses: Iterable[str]) -> None:
    """Make a folder polcap's own: creates it and its record, unless it has one.

    `uses` are the names of files and folders that polcap writes directly into it.

    Raises StorageError: one of these is there already without a record, or a link is in the record's place.
    """
    if is_claimed(folder):
        return
    record = folder / RECORD
    if record.is_symlink():
        raise StorageError(f"{record} is a link; remove it, or choose another --out")
    if record.exists() and not _is_cut(record):
        raise StorageError(f"{record} is no record of polcap; move it away, or choose another --out")
    for name in uses:
        if os.path.lexists(folder / name):
            raise StorageError(
                f"{folder} holds {name}, but no {RECORD}: polcap did not write it, or the record was removed; "
                "choose another --out"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(record, os.O_CREAT | os.O_WRONLY | _NO_LINK, 0o666)
        with os.fdopen(handle, "wb") as file:
            if os.fstat(handle).st_size < len(_FIRST_LINE):  # another process may be faster
                file.write(_FIRST_LINE)
    except OSError as error:
        raise system_errors.cannot_write(record, error) from error


@contextmanager
def claimed(folder: Path, uses: Iterable[str]) -> Iterator[None]:
    """Context manager: as `claim`, then as `opened`."""
    claim(folder, uses)
    with opened(folder):
        yield


@contextmanager
def opened(folder: Path) -> Iterator[OwnFiles]:
    """Context manager: files that `atomic` writes into the folder are checked against its record, and recorded."""
    own = OwnFiles(folder)
    before = _opened.get(str(own.folder))
    own = _opened[str(own.folder)] = before or own
    try:
        yield own
    finally:
        if before is None:
            del _opened[str(own.folder)]


def owner(file: Path) -> OwnFiles | None:
    """The innermost opened folder that holds a file; None: the file is in no folder of polcap."""
    parents = Path(os.path.abspath(file)).parents
    return next((_opened[str(parent)] for parent in parents if str(parent) in _opened), None)
