"""A time limit for calls into a library that may hang."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

from polcap.errors import HardwareError

T = TypeVar("T")


class CallTimeout(HardwareError):
    """The call did not return. Its thread still runs, so the device must not be used again."""


def call_within(timeout_s: float, name: str, call: Callable[[], T]) -> T:
    """Run `call` in its own thread, so that Ctrl-C works meanwhile. Raises CallTimeout after `timeout_s`."""
    answer: Future[T] = Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=run, daemon=True, name=name).start()
    if not wait([answer], timeout_s).done:
        raise CallTimeout(f"{name} took more than {timeout_s:g} s; switch the device off and on, check its cable")
    return answer.result()
