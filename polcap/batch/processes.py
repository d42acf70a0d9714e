"""Batch processing in several processes of this machine; a process that dies is replaced."""

import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any

from polcap import resource_limits
from polcap.batch import unit as units
from polcap.batch import worker_start
from polcap.batch.unit import ProcessOptions, Unit, UnitRecord

_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


@dataclass
class _BatchProcess:
    """A child process, its pipe and its current unit."""

    process: Any
    pipe: connection.Connection
    busy: tuple[Unit, int] | None = None  # with the attempt's number

    @staticmethod
    def start(options: ProcessOptions) -> "_BatchProcess":
        context = worker_start.context()
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there, options, dict(os.environ)), daemon=False)
        process.start()
        there.close()
        return _BatchProcess(process, here)

    def send(self, unit: Unit, attempt: int) -> None:
        self.busy = unit, attempt
        self.pipe.send((unit, attempt))

    def stop(self) -> None:
        self.pipe.close()  # an idle child then ends
        if self.busy:
            self.process.terminate()
        self.process.join()


def run(wanted: Sequence[Unit], options: ProcessOptions, workers: int, retries: int) -> Iterator[UnitRecord]:
    """Records of the units, in the order in which they end; if its process dies, a unit is retried `retries` times."""
    worker_start.preload()
    queue = deque((unit, 1) for unit in wanted)
    children = [_BatchProcess.start(options) for _ in range(min(workers, len(wanted)))]
    try:
        for child in children:
            child.send(*queue.popleft())
        while busy := [child for child in children if child.busy]:
            ready = connection.wait([item for child in busy for item in (child.pipe, child.process.sentinel)])
            for child in busy:
                if child.pipe not in ready and child.process.sentinel not in ready:
                    continue
                record = _answer(child)
                if record is None:
                    assert child.busy is not None
                    unit, attempt = child.busy
                    child.busy = None
                    child.stop()
                    children[children.index(child)] = child = _BatchProcess.start(options)
                    if attempt <= retries:
                        queue.append((unit, attempt + 1))
                    else:
                        yield units.crashed(unit, _DIED.format(attempts=attempt), attempt)
                else:
                    child.busy = None
                    yield record
                if queue:
                    child.send(*queue.popleft())
    finally:
        for child in children:
            child.stop()


def _answer(child: _BatchProcess) -> UnitRecord | None:
    try:
        return child.pipe.recv() if child.pipe.poll() else None
    except (EOFError, OSError):
        return None


def _serve(pipe: connection.Connection, options: ProcessOptions, environment: dict[str, str]) -> None:
    """Main function of a child: process units until the pipe closes.

    The environment is set first, because the child may be forked from an older server process.
    """
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    prepare(options)
    while True:
        try:
            unit, attempt = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(units.run(unit, options, attempt))


def prepare(options: ProcessOptions) -> None:
    """Limit the threads and the memory of this process."""
    resource_limits.set_threads(options.threads)
    resource_limits.set_memory(options.memory_gb)
