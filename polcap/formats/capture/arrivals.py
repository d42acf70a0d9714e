"""Watches a folder that a camera is filling, or a file that somebody edits: waits until changes have ended."""

import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from polcap.formats.capture.foreign_files import files_below

_POLL_S = 0.1  # between two listings of the files

FileStates = dict[str, tuple[int, int]]  # size and time of change by path


def settled(folder: Path, ignored: Path, still_s: float = 2.0, edited: Sequence[Path] = ()) -> Iterator[None]:
    """Watch a folder: yield at once, then whenever files have changed and after that stayed the same for `still_s` s.

    The folder `ignored` (of results) and files of other programs are not watched. An editor saves the files
    `edited` in one step, so their changes count as ended at the next poll.
    """
    folder, ignored = folder.resolve(), ignored.resolve()
    reported: tuple[FileStates, FileStates] | None = None
    last, edited_states, since = _stats(files_below(folder, ignored)), _stats(edited), time.monotonic()
    while True:
        now, edited_now = _stats(files_below(folder, ignored)), _stats(edited)
        if now != last:
            since = time.monotonic()
        still = reported is None or now == reported[0] or time.monotonic() - since >= still_s
        if (now, edited_now) == (last, edited_states) != reported and still:  # equal twice, and new
            reported = now, edited_now
            yield
        else:
            last, edited_states = now, edited_now
        time.sleep(_POLL_S)


def _stats(files: Iterable[Path]) -> FileStates:
    """Size and modification time of those of the files that exist."""
    found: FileStates = {}
    for file in files:
        try:
            status = file.stat()
        except OSError:
            continue
        found[str(file)] = status.st_size, status.st_mtime_ns
    return found
