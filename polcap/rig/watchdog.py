"""In: a call into a library that may hang. Out: what it returns, or an error in time."""

import threading
from collections.abc import Callable
from typing import TypeVar

from polcap.errors import HardwareError

T = TypeVar("T")


class Stalled(HardwareError):
    """The call did not return; its thread is left behind, and the device may not be touched again."""


def within(timeout_s: float, what: str, call: Callable[[], T]) -> T:
    """Run `call` in a thread of its own for at most `timeout_s`; Ctrl-C gets through meanwhile.

    Raises
    ------
    Stalled
        It took longer.
    """
    result: list[T] = []
    failure: list[BaseException] = []
    over = threading.Event()

    def run() -> None:
        try:
            result.append(call())
        except BaseException as error:
            failure.append(error)
        finally:
            over.set()

    threading.Thread(target=run, daemon=True, name=what).start()
    if not over.wait(timeout_s):
        raise Stalled(f"{what} took more than {timeout_s:g} s; switch the device off and on, check its cable")
    if failure:
        raise failure[0]
    return result[0]
