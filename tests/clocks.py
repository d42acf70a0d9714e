"""A clock for tests of code that waits: its time passes only in `sleep`."""

from collections.abc import Callable


class SleepClock:
    """Replaces the module `time`; `meanwhile` is called during each sleep, e.g. to write the file that is awaited."""

    def __init__(self) -> None:
        self.now = 0.0
        self.meanwhile: Callable[[], object] = lambda: None

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.meanwhile()
