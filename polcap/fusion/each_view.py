"""Runs one step on all views of a session, in child processes or one after the other; a view may fail alone."""

import traceback
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TypeVar

from polcap.errors import (
    AlignmentError,
    CaptureError,
    ChartError,
    DecodeError,
    InputError,
    ObjectError,
    SettingError,
)
from polcap.process_pool import Died, ProcessPool

RETRIES = 1  # of a view, if its process died
# faults of a view, without which the others go on; settings, models and the disk are common to all
FAULTS = (CaptureError, DecodeError, ChartError, AlignmentError, ObjectError)
T = TypeVar("T")
R = TypeVar("R")


def run(
    work: Callable[[T], R], views: Mapping[str, T], pool: ProcessPool | None, done: Callable[[str], None]
) -> tuple[dict[str, R], dict[str, str]]:
    """Results of `work` by view, and for each view in which it failed the reason. `done` is called with each name.

    Raises SettingError: a process died at every attempt.
    """
    outcomes = {}
    for name, outcome in _outcomes(work, views, pool):
        outcomes[name] = outcome
        done(name)
    results, failed = dict[str, R](), dict[str, str]()
    for name in views:  # in their order, not in that of their ends
        outcome = outcomes[name]
        if isinstance(outcome, FAULTS):
            failed[name] = reason(outcome, name)
        elif isinstance(outcome, Exception):
            raise outcome
        elif isinstance(outcome, Died):
            raise SettingError(
                f"{name}: its process died {outcome.attempts} times, most often from lack of memory; "
                "run fewer --workers"
            )
        else:
            results[name] = outcome
    return results, failed


def reason(error: InputError, name: str) -> str:
    """Why a view is left out, without its name or folder at the beginning."""
    return str(error).removeprefix(f"{name}: ")


def _outcomes(
    work: Callable[[T], R], views: Mapping[str, T], pool: ProcessPool | None
) -> Iterator[tuple[str, R | Exception | Died]]:
    """Name and outcome of each view, as they end."""
    if pool is not None:
        for (name, _), outcome in pool.run(partial(_outcome, work), list(views.items())):
            yield name, outcome
        return
    for name, view in views.items():
        try:
            yield name, work(view)
        except FAULTS as error:
            yield name, error


def _outcome(work: Callable[[T], R], named: tuple[str, T], _: int) -> R | Exception:
    """Result of a view, or its error with a traceback for the process that raises it again."""
    try:
        return work(named[1])
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error
