"""Child processes of this machine that work on many tasks; a process that dies is replaced.

`polcap batch` runs its captures in them, `polcap fuse` its views.
"""

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from types import TracebackType
from typing import Any, Self, TypeVar

from polcap import resource_limits
from polcap.batch import unit as units
from polcap.batch.unit import ProcessOptions, Unit, UnitRecord

T = TypeVar("T")
R = TypeVar("R")

# Each process imports polcap itself. Processes forked from a server would need a Unix socket below $TMPDIR, where a
# long path fails.
_SPAWN = multiprocessing.get_context("spawn")
_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


@dataclass(frozen=True)
class Limits:
    """Limits of each child process."""

    threads: int = 0  # 0: all
    memory_gb: float = 0.0  # 0: no limit


UNLIMITED = Limits()


@dataclass(frozen=True)
class Died:
    """Outcome of a task whose process died at every attempt."""

    attempts: int


@dataclass(frozen=True)
class _Call:
    """A function's call on a task."""

    function: Callable[..., Any]
    task: Any
    attempt: int


class _Child:
    """A child process, its pipe and the call that it executes."""

    def __init__(self, limits: Limits) -> None:
        self.pipe, there = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(there, limits))
        self.process.start()
        there.close()
        self.busy: _Call | None = None

    def send(self, call: _Call) -> None:
        self.busy = call
        self.pipe.send(call)

    def receive(self) -> Any:
        """Wait for the outcome of the call; None if the process died."""
        try:
            return self.pipe.recv() if self.pipe.poll() else None
        except (EOFError, OSError):
            return None

    def stop(self) -> None:
        self.pipe.close()  # an idle child then ends
        if self.busy:
            self.process.terminate()
        self.process.join()


class ProcessPool:
    """Up to `workers` child processes, which live from one `run` to the next."""

    def __init__(self, workers: int, retries: int, limits: Limits) -> None:
        self._workers, self._retries, self._limits = workers, retries, limits
        self._children: list[_Child] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for child in self._children:
            child.stop()

    def run(self, function: Callable[[T, int], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Died]]:
        """Call `function` on each task and the number of the attempt; yields tasks and outcomes as they end.

        The function is found by its name, and never returns None. If its process dies, a task is begun again, up to
        `retries` times.
        """
        queue = deque(_Call(function, task, 1) for task in tasks)
        while len(self._children) < min(self._workers, len(tasks)):
            self._children.append(_Child(self._limits))
        for child in self._children[: len(tasks)]:
            child.send(queue.popleft())
        while busy := {child.process.sentinel: child for child in self._children if child.busy}:
            ready = connection.wait([*busy, *(child.pipe for child in busy.values())])
            for sentinel, child in busy.items():
                if child.pipe not in ready and sentinel not in ready:
                    continue
                assert child.busy is not None
                call, outcome = child.busy, child.receive()
                child.busy = None
                if outcome is None:
                    child = self._replaced(child)
                    if call.attempt <= self._retries:
                        queue.append(_Call(function, call.task, call.attempt + 1))
                    else:
                        outcome = Died(call.attempt)
                if outcome is not None:
                    yield call.task, outcome
                if queue:
                    child.send(queue.popleft())

    def _replaced(self, child: _Child) -> _Child:
        """A new child process in the place of one that died."""
        child.stop()
        new = _Child(self._limits)
        self._children[self._children.index(child)] = new
        return new


def run(wanted: Sequence[Unit], options: ProcessOptions, workers: int, retries: int) -> Iterator[UnitRecord]:
    """Process captures in several child processes; yields records in the order in which captures end."""
    limits = Limits(options.threads, options.memory_gb)
    with ProcessPool(workers, retries, limits) as pool:
        for unit, outcome in pool.run(partial(_process, options), wanted):
            if isinstance(outcome, Died):
                yield units.crashed(unit, _DIED.format(attempts=outcome.attempts), outcome.attempts)
            else:
                yield outcome


def _process(options: ProcessOptions, unit: Unit, attempt: int) -> UnitRecord:
    return units.run(unit, options, attempt)


def _serve(pipe: connection.Connection, limits: Limits) -> None:
    """Main function of a child process: execute calls until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    prepare(limits)
    while True:
        try:
            call = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(call.function(call.task, call.attempt))


def prepare(limits: Limits | ProcessOptions) -> None:
    """Limit the threads and the memory of a process."""
    resource_limits.set_threads(limits.threads)
    resource_limits.set_memory(limits.memory_gb)
