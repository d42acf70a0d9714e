"""Runs one step on all views of a session, in child processes or one after the other; a view may fail alone."""

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from polcap.errors import SettingError
from polcap.fusion.session_views import FAULTS, Session, SessionInput, reason
from polcap.fusion.view_path import SessionView
from polcap.process_pool import Died, Limits, ProcessPool

Notify = Callable[[str], None]  # is called with a line on the step that is done
_RETRIES = 1  # of a view, if its process died
R = TypeVar("R")


@dataclass(frozen=True)
class StepRunner:
    """Runs a step on all views of a session, and reports it."""

    pool: ProcessPool | None  # None: in this process
    notify: Notify

    def __call__(self, step: str, work: Callable[[SessionView], R], session: Session) -> tuple[Session, dict[str, R]]:
        """The session without the views in which the step failed, and the results by view.

        Raises CaptureError: too few views are left. SettingError: a process died at every attempt.
        """
        outcomes = {}
        for name, outcome in _outcomes(work, session.views, self.pool):
            outcomes[name] = outcome
            self.notify(f"{name}: {step}")
        results, failed = dict[str, R](), dict[str, str]()
        for name in session.views:  # in their order, not in that of their ends
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
        return session.without(failed), results


@contextmanager
def step_runner(session_input: SessionInput[Any], notify: Notify) -> Iterator[StepRunner]:
    """Context manager: a step runner with a child process for each of the `workers`, if there are several."""
    if session_input.workers == 1:
        yield StepRunner(None, notify)
        return
    limits = Limits(session_input.request.threads, session_input.request.memory_gb)
    with ProcessPool(session_input.workers, _RETRIES, limits) as pool:
        yield StepRunner(pool, notify)


def _outcomes(
    work: Callable[[SessionView], R], views: Mapping[str, SessionView], pool: ProcessPool | None
) -> Iterator[tuple[str, R | Exception | Died]]:
    """Name and outcome of each view, as they end: its result, its error, or that its process died.

    Without a pool, errors other than FAULTS are raised.
    """
    if pool is not None:
        for (name, _), outcome in pool.run(partial(_outcome, work), list(views.items())):
            yield name, outcome
        return
    for name, view in views.items():
        try:
            yield name, work(view)
        except FAULTS as error:
            yield name, error


def _outcome(work: Callable[[SessionView], R], named: tuple[str, SessionView], _attempt: int) -> R | Exception:
    """Result of `work` on a named view, or its error, with a traceback for the process that raises it again."""
    try:
        return work(named[1])
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error
