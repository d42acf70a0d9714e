"""Limits the threads and memory of this process, and explains errors when memory runs out."""

import math
import os
import re
from typing import Any

from polcap.errors import SettingError

_MOST_GB = 1e9  # largest limit that systems accept
_LEAST_GB = 0.8  # for libraries, networks and a capture of 1 MP; it fails with 0.75, and a library hangs with 0.4
OUT_OF_MEMORY = (  # messages of OpenCV, pybind11, onnxruntime, threads, the loader of libraries and the system
    "Insufficient memory", "bad_alloc", "bad allocation", "Failed to allocate memory", "can't start new thread",
    "failed to map segment", "Cannot allocate memory",
)  # fmt: skip
_GB_PER_PIXEL, _GB_FIXED = 55e-9, 0.55  # memory of a run: per RAW pixel, fixed (measured, docs/explanations/scale.md)
_HEADROOM = 1.1  # factor on the memory at which a request failed, because later requests may be larger
_REQUESTED = re.compile(r"allocate ([\d.]+) (bytes|KiB|MiB|GiB)")  # numpy, OpenCV
_BYTES = {"bytes": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


def set_limits(threads: int, gigabytes: float) -> None:
    """Limit the threads and the private memory [GB] of this process; 0: no limit.

    Called before any numerical library starts its own threads. An allocation beyond the limit fails.

    Raises SettingError: the number of threads is negative, or as `check_memory`.
    """
    if threads < 0:
        raise SettingError(f"--threads {threads}: give a number of threads, or 0 for all")
    check_memory(gigabytes)
    if threads:
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(threads)
        import cv2

        cv2.setNumThreads(threads)
    if gigabytes:
        resource = _resource(gigabytes)
        size, maximum = int(gigabytes * 1e9), resource.getrlimit(resource.RLIMIT_DATA)[1]
        if maximum != resource.RLIM_INFINITY:  # the administrator's limit is not raised
            size = min(size, maximum)
        resource.setrlimit(resource.RLIMIT_DATA, (size, maximum))


def check_memory(gigabytes: float) -> None:
    """Raise a SettingError for a limit that no system accepts, that is too low for any capture, or unknown here."""
    if not 0 <= gigabytes <= _MOST_GB:
        raise SettingError(f"--memory {gigabytes:g}: give a number of GB up to {_MOST_GB:g}, or leave it out")
    if 0 < gigabytes < _LEAST_GB:
        raise SettingError(
            f"--memory {gigabytes:g}: libraries and networks take {_LEAST_GB:g} GB before any picture; "
            "raise it, or leave it out"
        )
    if gigabytes:
        _resource(gigabytes)


def _resource(gigabytes: float) -> Any:
    """The module `resource`. Raises SettingError: this system has none."""
    try:
        import resource
    except ImportError as error:
        raise SettingError(f"--memory {gigabytes:g}: this system knows no such limit; leave it out") from error
    return resource


def is_shortfall(error: BaseException | None) -> bool:
    """Whether an error, or one of its causes, means that memory ran out."""
    if error is None:
        return False
    found = isinstance(error, MemoryError) or any(word in str(error) for word in OUT_OF_MEMORY)
    return found or is_shortfall(error.__cause__)


def shortfall(error: BaseException, stage: str, pixels: int) -> SettingError:
    """The error for a stage that runs out of memory: memory used and requested, estimate for the run, remedy.

    `pixels` is the number of pixels of a RAW frame.
    """
    from polcap.stages.hdr import planes

    used, limit = planes.process_memory()
    request = _REQUESTED.search(str(error))
    extra = float(request[1]) * _BYTES[request[2]] if request else 0.0
    needed_gb = max(_GB_PER_PIXEL * pixels + _GB_FIXED, _HEADROOM * (used + extra) / 1e9, _LEAST_GB)
    rounded_gb = math.ceil(10 * needed_gb) / 10
    message = f"{stage}: out of memory"
    if used:
        message += f" with {used / 1e9:.2f} GB used" + (f" and {extra / 1e9:.2g} GB more requested" if extra else "")
    message += f"; a capture of {pixels / 1e6:.3g} MP takes about {rounded_gb:.1f} GB in all"
    if limit is None:
        return SettingError(f"{message}: free that much, process fewer captures at a time, or use a larger machine")
    return SettingError(f"{message}: raise --memory from {limit / 1e9:.3g} to that, or leave it out")
