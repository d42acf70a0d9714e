"""Tasks side by side: each is done once, their results come in order, and so do their errors."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from polcap import parallel


@pytest.mark.parametrize("most", [1, 2, 8])
def test_results_come_in_order_and_each_task_is_done_once(most: int) -> None:
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


def test_the_caller_works_beside_the_task() -> None:
    met = threading.Event()
    with parallel.Beside(2) as beside:
        task = beside.begin(partial(met.wait, 60))
        met.set()  # by the caller, while the task waits for it
        assert task.result()


def test_tasks_that_nobody_has_begun_are_dropped_when_the_caller_fails() -> None:
    began, dropped, done, waiting = threading.Event(), threading.Event(), list[int](), list[parallel.Task[None]]()

    def first() -> None:
        began.set()
        dropped.wait(60)

    with pytest.raises(KeyboardInterrupt), parallel.Beside(2) as beside:
        beside.begin(first)
        waiting += [beside.begin(partial(done.append, n)) for n in range(3)]
        waiting[-1].future.add_done_callback(lambda _: dropped.set())
        assert began.wait(60)
        raise KeyboardInterrupt
    assert done == [] and all(one.future.cancelled() for one in waiting)


def test_the_number_of_threads_is_what_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert parallel.threads() == 3
    for nothing in ("", "0", "all", "²"):
        monkeypatch.setenv("OMP_NUM_THREADS", nothing)
        assert parallel.threads() >= 1


def test_a_value_is_made_once_whichever_threads_ask() -> None:
    made: list[int] = []
    here = threading.Barrier(4)

    def make() -> int:
        made.append(1)
        return 7

    once = parallel.Once(make)

    def ask() -> int:
        here.wait(60)
        return once()

    with ThreadPoolExecutor(4) as pool:
        assert [one.result(60) for one in [pool.submit(ask) for _ in range(4)]] == [7] * 4
    assert made == [1]
