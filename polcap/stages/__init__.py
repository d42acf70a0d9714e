"""The stages of the path: pure functions that take and return frozen dataclasses. `results.py` lists them.

A stage opens no file and logs nothing: it returns a new value or raises.
Stages do not import each other. Code that two of them use is in `optics/`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec, TypeVar

import polcap.optics  # noqa: F401  refuses another OpenCV before a stage imports it

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Stage(Generic[P, T]):
    """A stage: a pure function, with a version number that is raised whenever its results change."""

    function: Callable[P, T]
    version: int
    keep: bool  # False: cheaper to compute again than to store
    uses: tuple["Stage[..., Any]", ...] = ()  # stages that the function calls; their versions are a part of its own

    @property
    def name(self) -> str:
        return self.function.__module__.rpartition(".")[2]

    @property
    def versions(self) -> int | list[Any]:
        """The version, with those of the used stages if there are any."""
        return [self.version, *(used.versions for used in self.uses)] if self.uses else self.version

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """Run the stage's function."""
        return self.function(*args, **kwargs)


def stage(
    *, version: int, keep: bool = True, uses: tuple[Stage[..., Any], ...] = ()
) -> Callable[[Callable[P, T]], Stage[P, T]]:
    """Decorator that makes the one public function of a stage's module a `Stage`."""
    return lambda function: Stage(function, version, keep, uses)
