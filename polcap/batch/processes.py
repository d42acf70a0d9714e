"""Runs the captures of a batch in child processes of this machine."""

from collections.abc import Iterator, Sequence
from functools import partial

from polcap.batch import unit as units
from polcap.batch.unit import Unit, UnitRecord
from polcap.pipeline.request import Request
from polcap.process_pool import Died, Limits, ProcessPool

_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


def run(wanted: Sequence[Unit], request: Request, workers: int, retries: int) -> Iterator[UnitRecord]:
    """Process captures in several child processes; yields records in the order in which captures end."""
    limits = Limits(request.threads, request.memory_gb)
    before = {unit: units.read_record(unit) for unit in wanted}
    with ProcessPool(workers, retries, limits) as pool:
        for unit, outcome in pool.run(partial(_process, request), wanted):
            if isinstance(outcome, Died):
                message = _DIED.format(attempts=outcome.attempts)
                yield units.record_crash(unit, before[unit], message, outcome.attempts)
            else:
                yield outcome


def _process(request: Request, unit: Unit, attempt: int) -> UnitRecord:
    return units.run(unit, request, attempt)
