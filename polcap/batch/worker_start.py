"""In: nothing. Out: the way in which worker processes start, with all that a capture needs loaded.

On Linux they are forked from a server that has imported it once and runs no thread: nothing is copied amid work, a
worker is there in a tenth of a second, and what all of them read lies in memory once. Elsewhere each imports alone.
"""

import multiprocessing
import sys
from typing import Any

_LOADED = ["polcap.batch.loaded"]


def method() -> str:
    """Name of the start method, as multiprocessing and Dask know it."""
    return "forkserver" if sys.platform == "linux" else "spawn"


def begin(*also: str) -> None:
    """Have the server import what workers need, and these modules, while the caller goes on."""
    if method() == "forkserver":
        from multiprocessing import forkserver

        forkserver.set_forkserver_preload([*_LOADED, *also])
        forkserver.ensure_running()


def context() -> Any:
    """The multiprocessing context of workers."""
    return multiprocessing.get_context(method())
