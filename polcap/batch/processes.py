"""Batch processing in several processes of this machine; a process that dies is replaced."""

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from multiprocessing import connection

from polcap import resource_limits
from polcap.batch import unit as units
from polcap.batch.unit import ProcessOptions, Unit, UnitRecord

# Each process imports polcap itself. Processes forked from a server would need a Unix socket below $TMPDIR, where a
# long path fails.
_SPAWN = multiprocessing.get_context("spawn")
_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


class _BatchProcess:
    """A child process of a batch, its pipe and the capture that it processes."""

    def __init__(self, options: ProcessOptions) -> None:
        self.pipe, there = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(there, options))
        self.process.start()
        there.close()
        self.busy: tuple[Unit, int] | None = None  # with the attempt's number

    def send(self, unit: Unit, attempt: int) -> None:
        self.busy = unit, attempt
        self.pipe.send((unit, attempt))

    def receive(self) -> UnitRecord | None:
        """Wait for the record of the capture being processed; None if the process died."""
        try:
            return self.pipe.recv() if self.pipe.poll() else None
        except (EOFError, OSError):
            return None

    def stop(self) -> None:
        self.pipe.close()  # an idle child then ends
        if self.busy:
            self.process.terminate()
        self.process.join()


def run(wanted: Sequence[Unit], options: ProcessOptions, workers: int, retries: int) -> Iterator[UnitRecord]:
    """Process captures in several child processes; yields records in the order in which captures end.

    If its process dies, a capture is processed again, up to `retries` times.
    """
    queue = deque((unit, 1) for unit in wanted)
    children = [_BatchProcess(options) for _ in range(min(workers, len(wanted)))]
    try:
        for child in children:
            child.send(*queue.popleft())
        while busy := {child.process.sentinel: child for child in children if child.busy}:
            ready = connection.wait([*busy, *(child.pipe for child in busy.values())])
            for sentinel, child in busy.items():
                if child.pipe not in ready and sentinel not in ready:
                    continue
                assert child.busy is not None
                (unit, attempt), record = child.busy, child.receive()
                child.busy = None
                if record is None:
                    child.stop()
                    children[children.index(child)] = child = _BatchProcess(options)
                    if attempt <= retries:
                        queue.append((unit, attempt + 1))
                    else:
                        record = units.crashed(unit, _DIED.format(attempts=attempt), attempt)
                if record is not None:
                    yield record
                if queue:
                    child.send(*queue.popleft())
    finally:
        for child in children:
            child.stop()


def _serve(pipe: connection.Connection, options: ProcessOptions) -> None:
    """Main function of a child process of a batch: process captures until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    prepare(options)
    while True:
        try:
            unit, attempt = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(units.run(unit, options, attempt))


def prepare(options: ProcessOptions) -> None:
    """Limit the threads and the memory of a process as the options of the batch ask."""
    resource_limits.set_threads(options.threads)
    resource_limits.set_memory(options.memory_gb)
