"""Start of worker processes.

On Linux, workers are forked from a server process that has imported all modules and runs no threads, so that workers
share its memory. On other systems each worker imports the modules itself.
"""

import multiprocessing
import sys
from typing import Any


def method() -> str:
    """Name of the start method, as multiprocessing and Dask know it."""
    return "forkserver" if sys.platform == "linux" else "spawn"


def preload(*modules: str) -> None:
    """Start the server process, which imports the modules of `preloaded` and these in the background."""
    if method() == "forkserver":
        from multiprocessing import forkserver

        forkserver.set_forkserver_preload(["polcap.batch.preloaded", *modules])
        forkserver.ensure_running()


def context() -> Any:
    """The multiprocessing context of workers."""
    return multiprocessing.get_context(method())
