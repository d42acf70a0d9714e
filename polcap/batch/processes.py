"""Runs the captures of a batch in child processes of this machine."""

from collections.abc import Iterator, Sequence
from functools import partial

from polcap.batch import unit as units
from polcap.batch.unit import ProcessOptions, Unit, UnitRecord
from polcap.process_pool import Died, Limits, ProcessPool

_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


def run(wanted: Sequence[Unit], options: ProcessOptions, workers: int, retries: int) -> Iterator[UnitRecord]:
    """Process captures in several child processes; yields records in the order in which captures end."""
    limits = Limits(options.threads, options.memory_gb)
    before = {unit: units.read_record(unit) for unit in wanted}
    with ProcessPool(workers, retries, limits) as pool:
        for unit, outcome in pool.run(partial(_process, options), wanted):
            if isinstance(outcome, Died):
                message = _DIED.format(attempts=outcome.attempts)
                yield units.record_crash(unit, before[unit], message, outcome.attempts)
            else:
                yield outcome


def _process(options: ProcessOptions, unit: Unit, attempt: int) -> UnitRecord:
    return units.run(unit, options, attempt)
