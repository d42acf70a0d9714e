"""In: how much of the machine a command may take. Out: that limit, set for this process."""

import os
from typing import Any

from polcap.errors import SettingError

_MOST_GB = 1e9  # beyond what any system counts
_LEAST_GB = 0.8  # libraries and networks, and a capture of 1 MP: at .75 one fails, at .4 a library waits for ever


def set_threads(count: int) -> None:
    """Set the number of threads before any numerical library starts its own; 0 leaves it to them."""
    if count:
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(count)
        import cv2

        cv2.setNumThreads(count)


def check_memory(gigabytes: float) -> None:
    """Whether `set_memory` can set this limit.

    Raises
    ------
    SettingError
        It is no amount of memory, less than any capture needs, or the system knows no such limit.
    """
    if not 0 <= gigabytes <= _MOST_GB:
        raise SettingError(f"--memory {gigabytes:g}: give a number of GB up to {_MOST_GB:g}, or leave it out")
    if 0 < gigabytes < _LEAST_GB:
        raise SettingError(
            f"--memory {gigabytes:g}: libraries and networks take {_LEAST_GB:g} GB before any picture; "
            "raise it, or leave it out"
        )
    if gigabytes:
        _resource(gigabytes)


def set_memory(gigabytes: float) -> None:
    """Beyond this much of its own memory (mapped files apart) the process fails at once, and says so; 0 sets none.

    Raises
    ------
    SettingError
        As of `check_memory`.
    """
    check_memory(gigabytes)
    if not gigabytes:
        return
    resource = _resource(gigabytes)
    size, most = int(gigabytes * 1e9), resource.getrlimit(resource.RLIMIT_DATA)[1]
    if most != resource.RLIM_INFINITY:  # of the machine's owner: never raised
        size = min(size, most)
    resource.setrlimit(resource.RLIMIT_DATA, (size, most))


def _resource(gigabytes: float) -> Any:
    try:
        import resource
    except ImportError as error:
        raise SettingError(f"--memory {gigabytes:g}: this system knows no such limit; leave it out") from error
    return resource
