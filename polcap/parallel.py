"""In: tasks that need nothing of one another. Out: what each gives, made in as many threads as may run.

A caller counts as one of them: it works on its own beside the tasks, and helps with those that nobody has begun when it
waits. With one thread each task is done where it is asked for.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from types import TracebackType
from typing import Generic, Self, TypeVar

T = TypeVar("T")


def threads() -> int:
    """How many may run: as OMP_NUM_THREADS says, which `--threads` sets, else the cores that this process may use."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    if asked.isascii() and asked.isdecimal() and int(asked):
        return int(asked)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Once(Generic[T]):
    """A value that is made when it is first asked for, once whichever threads ask."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make, self._lock = make, Lock()
        self._made: list[T] = []

    def __call__(self) -> T:
        """The value, or what making it raises."""
        with self._lock:
            if not self._made:
                self._made.append(self._make())
            return self._made[0]


class Task(Generic[T]):
    """One that is under way, or will be."""

    def __init__(self, function: Callable[[], T], pool: ThreadPoolExecutor | None) -> None:
        self._function = function
        self.future: Future[T] = Future() if pool is None else pool.submit(function)
        self.alone = pool is None  # nobody else does it

    def help(self) -> None:
        """Do it here, where nobody has begun it."""
        if not self.alone and self.future.cancel():
            self.future, self.alone = Future(), True
        if self.alone and not self.future.done():
            try:
                self.future.set_result(self._function())
            except Exception as error:  # told as the result
                self.future.set_exception(error)

    def result(self) -> T:
        """What it gives, or raises."""
        self.help()
        return self.future.result()


class Beside:
    """Threads beside the caller's; tasks that nobody has begun are dropped when the block ends.

    Parameters
    ----------
    most
        Threads, the caller's too; None as many as may run.
    """

    def __init__(self, most: int | None = None) -> None:
        others = (threads() if most is None else most) - 1
        self._pool = ThreadPoolExecutor(others) if others > 0 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def begin(self, function: Callable[[], T]) -> Task[T]:
        """Have it done."""
        return Task(function, self._pool)


def results(functions: Iterable[Callable[[], T]], most: int | None = None) -> list[T]:
    """What each function gives, in their order; the costliest come first. Of errors the first in order is raised.

    Parameters
    ----------
    functions
        They need nothing of one another.
    most
        As of `Beside`.
    """
    with Beside(most) as beside:
        return finished([beside.begin(function) for function in functions])


def finished(tasks: list[Task[T]]) -> list[T]:
    """What tasks that were begun give, in their order; the caller takes from the end what nobody has begun."""
    for task in reversed(tasks):
        if not task.alone:
            task.help()
    return [task.result() for task in tasks]
