"""In: a folder that a camera or a person is filling. Out: each moment at which it has changed and come to rest."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

_POLL_S = 0.2

Seen = dict[str, tuple[int, int]]  # size and time of change by path


def settled(folder: Path, ignored: Path, still_s: float = 2.0) -> Iterator[None]:
    """Yield at once, then whenever files came, went or changed and then nothing moved for `still_s` seconds.

    `ignored` is not looked at (what is made of the folder may lie in it), nor is what begins with a dot.
    """
    folder, ignored = folder.resolve(), ignored.resolve()
    done: Seen | None = None
    last, since = _seen(folder, ignored), time.monotonic()
    while True:
        now = _seen(folder, ignored)
        if now != last:
            last, since = now, time.monotonic()
        elif now != done and (done is None or time.monotonic() - since >= still_s):
            done = now
            yield
        time.sleep(_POLL_S)


def _seen(folder: Path, ignored: Path) -> Seen:
    """All files below the folder; those that vanish meanwhile are left out."""
    found: Seen = {}
    for root, folders, files in os.walk(folder):
        here = Path(root)
        folders[:] = [name for name in folders if not name.startswith(".") and (here / name) != ignored]
        for name in files:
            if name.startswith("."):
                continue
            try:
                about = (here / name).stat()
            except OSError:
                continue
            found[str(here / name)] = about.st_size, about.st_mtime_ns
    return found
