"""Child processes of this machine that work on many tasks; a process that dies is replaced.

`polcap batch` runs its captures in them, `polcap fuse` its views.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any, Self, TypeVar

from polcap import resource_limits

T = TypeVar("T")
R = TypeVar("R")

# Each process imports polcap itself. Processes forked from a server would need a Unix socket below $TMPDIR, where a
# long path fails.
_SPAWN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Limits:
    """Limits of each child process."""

    threads: int = 0  # 0: all
    memory_gb: float = 0.0  # 0: no limit


@dataclass(frozen=True)
class Died:
    """Outcome of a task whose process died at every attempt."""

    attempts: int


class _Child:
    """A child process that executes one call at a time."""

    def __init__(self, limits: Limits) -> None:
        self._pipe, child_end = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_serve, args=(child_end, limits))
        self._process.start()
        child_end.close()

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Wait for the result of a function; None if the process died."""
        try:
            self._pipe.send((function, arguments))
            return self._pipe.recv()
        except (EOFError, OSError):
            return None

    def stop(self) -> None:
        self._process.terminate()
        self._process.join()


class ProcessPool:
    """Up to `workers` child processes, which live from one `run` to the next; a thread waits for each."""

    def __init__(self, workers: int, retries: int, limits: Limits) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self._retries, self._limits = retries, limits
        self._children: set[_Child] = set()
        self._idle: list[_Child] = []
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for child in list(self._children):
            child.stop()
        self._threads.shutdown()

    def run(self, function: Callable[[T, int], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Died]]:
        """Call `function` on each task and the number of the attempt; yields tasks and outcomes as they end.

        The function must be importable by its name, and must not return None. If its process dies, a task is begun
        again, up to `retries` times.
        """
        task_of_call = {self._threads.submit(self._call, function, task): task for task in tasks}
        for future in as_completed(task_of_call):
            yield task_of_call[future], future.result()

    def _call(self, function: Callable[[T, int], R], task: T) -> R | Died:
        """Call a function in an idle child process, or in a new one; in a thread of the pool."""
        attempt = 0
        while attempt <= self._retries and not self._closed:
            attempt += 1
            child = self._idle.pop() if self._idle else _Child(self._limits)
            self._children.add(child)
            outcome: R | None = None if self._closed else child.call(function, task, attempt)
            if outcome is not None:
                self._idle.append(child)
                return outcome
            self._children.discard(child)
            child.stop()
        return Died(attempt)


def _serve(pipe: connection.Connection, limits: Limits) -> None:
    """Main function of a child process: execute calls until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    resource_limits.set_limits(limits.threads, limits.memory_gb)
    while True:
        try:
            function, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(function(*arguments))


def _end_with_parent() -> None:
    """End this process when its parent dies: it would keep a result folder locked, which the next run needs."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
