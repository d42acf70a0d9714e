"""In: units. Out: their records, from processes of this machine that are replaced when one of them dies."""

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
from polcap.batch.unit import Order, Record, Unit


@dataclass
class _Hand:
    """A child process and what it is busy with."""

    process: Any
    pipe: connection.Connection
    busy: tuple[Unit, int] | None = None  # with the number of the attempt

    @staticmethod
    def start(order: Order) -> "_Hand":
        context = worker_start.context()
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there, order, dict(os.environ)), daemon=False)
        process.start()
        there.close()
        return _Hand(process, here)

    def give(self, unit: Unit, attempt: int) -> None:
        self.busy = unit, attempt
        self.pipe.send((unit, attempt))

    def stop(self) -> None:
        self.pipe.close()  # an idle child ends of itself
        if self.busy:
            self.process.terminate()
        self.process.join()


def run(wanted: Sequence[Unit], order: Order, workers: int, retries: int) -> Iterator[Record]:
    """Records in the order in which units end; a unit that kills its process is tried `retries` times more."""
    worker_start.begin()
    queue = deque((unit, 1) for unit in wanted)
    hands = [_Hand.start(order) for _ in range(min(workers, len(wanted)))]
    try:
        for hand in hands:
            hand.give(*queue.popleft())
        while busy := [hand for hand in hands if hand.busy]:
            heard = connection.wait([item for hand in busy for item in (hand.pipe, hand.process.sentinel)])
            for hand in busy:
                if hand.pipe not in heard and hand.process.sentinel not in heard:
                    continue
                record = _answer(hand)
                if record is None:
                    assert hand.busy is not None
                    unit, attempt = hand.busy
                    hand.busy = None
                    hand.stop()
                    hands[hands.index(hand)] = hand = _Hand.start(order)
                    if attempt <= retries:
                        queue.append((unit, attempt + 1))
                    else:
                        yield units.crashed(unit, _cause_of_death(attempt), attempt)
                else:
                    hand.busy = None
                    yield record
                if queue:
                    hand.give(*queue.popleft())
    finally:
        for hand in hands:
            hand.stop()


def _answer(hand: _Hand) -> Record | None:
    try:
        return hand.pipe.recv() if hand.pipe.poll() else None
    except (EOFError, OSError):
        return None


def _cause_of_death(attempts: int) -> str:
    return (
        f"its process died {attempts} times; most often memory runs out: run fewer --workers, lower --memory, "
        "or take it out of the batch"
    )


def _serve(pipe: connection.Connection, order: Order, environment: dict[str, str]) -> None:
    """Work until the pipe closes; in the child, which may come of a server that began in another environment."""
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    prepare(order)
    while True:
        try:
            unit, attempt = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(units.run(unit, order, attempt))


def prepare(order: Order) -> None:
    """Threads and memory of this process."""
    resource_limits.set_threads(order.threads)
    resource_limits.set_memory(order.memory_gb)
