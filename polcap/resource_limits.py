"""In: how much of the machine a command may take. Out: that limit, set for this process."""

import math
import os

from polcap.errors import SettingError


def set_threads(count: int) -> None:
    """Set the number of threads before any numerical library starts its own; 0 leaves it to them."""
    if count:
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(count)
        import cv2

        cv2.setNumThreads(count)


def set_memory(gigabytes: float) -> None:
    """Beyond this much of its own memory (mapped files apart) the process fails at once, and says so; 0 sets none."""
    if not gigabytes:
        return
    if not math.isfinite(gigabytes):
        raise SettingError(f"--memory {gigabytes}: give a number of GB, or leave it out")
    try:
        import resource
    except ImportError as error:
        raise SettingError(f"--memory {gigabytes:g}: this system knows no such limit; leave it out") from error
    size = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (size, resource.getrlimit(resource.RLIMIT_DATA)[1]))
