"""Runs independent calls on threads."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

A = TypeVar("A")
B = TypeVar("B")
T = TypeVar("T")


def threads() -> int:
    """Number of threads to use: OMP_NUM_THREADS, which `--threads` sets, or the cores that this process may use."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    if stated.isascii() and stated.isdecimal() and int(stated):
        return int(stated)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def results(functions: Iterable[Callable[[], T]], most: int | None = None) -> list[T]:
    """Results of the calls in their order, from at most `most` threads; raises the first error in this order.

    With one thread, the calls run in the caller's. After an error or Ctrl-C, no further call starts.
    """
    calls = list(functions)
    workers = min(len(calls), threads() if most is None else most)
    if workers < 2:
        return [call() for call in calls]
    pool = ThreadPoolExecutor(workers)
    try:
        return [future.result() for future in [pool.submit(call) for call in calls]]
    finally:
        pool.shutdown(cancel_futures=True)


def both(first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Run two functions at the same time on threads and return both results; see `results`."""
    calls: list[Callable[[], Any]] = [first, second]
    one, other = results(calls)
    return cast(A, one), cast(B, other)
