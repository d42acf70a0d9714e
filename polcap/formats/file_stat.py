"""In: a file. Out: what tells without reading it whether it is the one of before."""

import os
import time
from pathlib import Path

Stat = list[int]
_SETTLED_NS = 3_000_000_000  # a file system's clock may have steps of 2 s; in one step a file may change twice


def of(file: str | Path) -> Stat:
    """Size, time of the content, time of the last change of any kind, and which file it is. Raises OSError."""
    about = os.stat(file)
    return [about.st_size, about.st_mtime_ns, about.st_ctime_ns, about.st_ino]


def is_settled(newest_ns: int) -> bool:
    """Whether a file of this time of the content cannot change any more without another time."""
    return newest_ns <= time.time_ns() - _SETTLED_NS
