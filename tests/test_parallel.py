"""Calls on threads: each runs once, results come in order, and so do errors."""

import threading
import time
from collections.abc import Callable
from functools import partial

import pytest

from polcap import parallel


@pytest.mark.parametrize("most", [1, 2, 8])
def test_results_come_in_order_and_each_call_runs_once(most: int) -> None:
    done: list[int] = []

    def square(n: int) -> int:
        done.append(n)
        return n * n

    assert parallel.results([partial(square, n) for n in range(40)], most) == [n * n for n in range(40)]
    assert sorted(done) == list(range(40))
    assert most > 1 or done == sorted(done)


@pytest.mark.parametrize("most", [1, 2, 8])
def test_the_first_error_in_order_comes_out(most: int) -> None:
    def fail(n: int) -> None:
        if n in (3, 7):
            raise ValueError(f"{n}")

    with pytest.raises(ValueError, match="3"):
        parallel.results([partial(fail, n) for n in range(9)], most)


def test_calls_run_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    here = threading.Barrier(2)
    assert sorted(parallel.both(here.wait, here.wait)) == [0, 1]  # each waits for the other


def test_after_ctrl_c_no_further_call_begins() -> None:
    done = list[int]()

    def interrupted() -> None:
        raise KeyboardInterrupt

    def slow(n: int) -> None:
        done.append(n)
        time.sleep(0.2)

    calls: list[Callable[[], None]] = [partial(slow, n) for n in range(40)]
    with pytest.raises(KeyboardInterrupt):
        parallel.results([interrupted, *calls], 2)
    assert len(done) < 5


def test_the_number_of_threads_is_what_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert parallel.threads() == 3
    for nothing in ("", "0", "all", "²"):
        monkeypatch.setenv("OMP_NUM_THREADS", nothing)
        assert parallel.threads() >= 1
