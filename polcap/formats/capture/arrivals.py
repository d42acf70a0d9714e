"""In: a folder that a camera or a person is filling, files that somebody edits. Out: when to look at them again."""

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

_POLL_S = 0.1

Seen = dict[str, tuple[int, int]]  # size and time of change by path


def settled(folder: Path, ignored: Path, still_s: float = 2.0, edited: Sequence[Path] = ()) -> Iterator[None]:
    """Yield at once, then whenever files came, went or changed and came to rest.

    Parameters
    ----------
    folder
        It rests when nothing in it has moved for `still_s` seconds.
    ignored
        Not looked at (what is made of the folder may lie in it), nor is what begins with a dot.
    still_s
        As said.
    edited
        Files beside it that are written in one go, as editors save: they rest at the next look.
    """
    folder, ignored = folder.resolve(), ignored.resolve()
    done: tuple[Seen, Seen] | None = None
    last, texts, since = _seen(folder, ignored), _stats(edited), time.monotonic()
    while True:
        now, texts_now = _seen(folder, ignored), _stats(edited)
        if now != last:
            since = time.monotonic()
        still = done is None or now == done[0] or time.monotonic() - since >= still_s
        if (now, texts_now) == (last, texts) != done and still:
            done = now, texts_now
            yield
        else:
            last, texts = now, texts_now
        time.sleep(_POLL_S)


def _seen(folder: Path, ignored: Path) -> Seen:
    """All files below the folder; those that vanish meanwhile are left out."""
    found: Seen = {}
    for root, folders, files in os.walk(folder):
        here = Path(root)
        folders[:] = [name for name in folders if not name.startswith(".") and (here / name) != ignored]
        found |= _stats(here / name for name in files if not name.startswith("."))
    return found


def _stats(files: Iterable[Path]) -> Seen:
    """Of those that are there."""
    found: Seen = {}
    for file in files:
        try:
            about = file.stat()
        except OSError:
            continue
        found[str(file)] = about.st_size, about.st_mtime_ns
    return found
