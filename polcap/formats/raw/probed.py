"""In: photographs, from any thread. Out: what each tells of itself, read once and remembered with the result.

A file whose size and times are those of then is not read again: a late change need not wait for a hundred megabytes,
nor start the process that reads them. Whoever decodes it compares the bytes with the digest told here.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path

import msgspec

from polcap.formats import atomic, file_stat, text_file
from polcap.formats.raw import probe
from polcap.formats.raw.probe import Probe
from polcap.formats.written import digest


class _Kept(msgspec.Struct, frozen=True):
    """What is read of the file."""

    program: str
    files: dict[str, tuple[file_stat.Stat, Probe]]
    digest: str


class Probed:
    """Asks `probe.read` about each file, once.

    Parameters
    ----------
    memory
        File of an earlier run's answers; None remembers this process's alone.
    program
        Digest of the program: what another understood is not taken.
    """

    def __init__(self, memory: Path | None = None, program: str = "") -> None:
        self._memory, self._program = memory, program
        self._known = {} if memory is None else _read(memory, program)
        self._before = dict(self._known)

    def __call__(self, path: Path) -> Probe:
        """As `probe.read`."""
        name = os.path.abspath(path)
        try:
            now = file_stat.of(path)
        except OSError:
            return probe.read(path)  # which says what is wrong with it
        if name in self._known and self._known[name][0] == now:
            return self._known[name][1]
        found = probe.read(path)
        if file_stat.is_settled(now[1]):
            self._known[name] = (now, found)
        return found

    def remember(self) -> None:
        """Write down what the next run finds, where there is anything new.

        Raises
        ------
        StorageError
            The file cannot be written.
        """
        if self._memory is None or self._known == self._before:
            return
        files = {name: [stat, asdict(found)] for name, (stat, found) in self._known.items()}
        sealed = {"program": self._program, "files": files, "digest": digest([self._program, files])}
        with atomic.path(self._memory, synced=False) as temporary:
            temporary.write_text(json.dumps(sealed), encoding="utf-8", errors="surrogateescape")
        self._before = dict(self._known)


def _read(file: Path, program: str) -> dict[str, tuple[file_stat.Stat, Probe]]:
    """What the file tells; nothing where it is missing, damaged, or of another program."""
    try:
        said = text_file.read_json(file)
        kept = msgspec.convert(said, _Kept)
    except (OSError, ValueError):
        return {}
    whole = kept.program == program and kept.digest == digest([kept.program, said["files"]])
    return dict(kept.files) if whole else {}
