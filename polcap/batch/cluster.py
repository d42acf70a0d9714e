"""Batch processing on a Dask cluster (extra [batch]).

If a worker is lost, the scheduler passes its capture to another one, which continues from the stage cache.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from polcap import resource_limits
from polcap.batch import unit as units
from polcap.batch.unit import Unit, UnitRecord
from polcap.errors import SettingError, package_for
from polcap.pipeline.request import Request

_ANSWER_S = 10.0  # within which a scheduler answers
_SETTINGS = {
    "distributed.worker.profile.enabled": False,  # costs 6 % of a small capture's time
    "distributed.nanny.pre-spawn-environ": {  # without MALLOC_TRIM_THRESHOLD_, which slows down every large array
        "OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1,
    },
}  # fmt: skip


def run(
    wanted: Sequence[Unit],
    request: Request,
    address: str,
    workers: int,
    retries: int,
    print_line: Callable[[str], None],
) -> Iterator[UnitRecord]:
    """Process captures on a Dask cluster; yields their records in the order in which they end.

    `address` names a running scheduler, for example tcp://host:8786, and its workers must see the same folders;
    `local` starts one with `workers` processes on this machine. With device cuda a unit requests the resource GPU.

    Raises SettingError: Dask is not installed, or no scheduler answers at the address.
    """
    with package_for("--scheduler", "Dask", "batch"):
        import dask
        import distributed
    resources = {"GPU": 1.0} if request.device == "cuda" else None
    with dask.config.set({"distributed.scheduler.allowed-failures": retries, **_SETTINGS}):
        target: Any = address
        try:
            if address == "local":
                target = distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    resources=resources,
                    dashboard_address="127.0.0.1:0",  # a host that is left out means all networks
                )
            client = distributed.Client(target, timeout=_ANSWER_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise SettingError(f"--scheduler {address}: no scheduler answers there ({error}); start one") from error
        try:
            print_line(f"dashboard {client.dashboard_link}")
            yield from _gather(client, wanted, request, resources, retries)
        finally:
            client.close()
            if target is not address:
                target.close()


def _gather(
    client: Any, wanted: Sequence[Unit], request: Request, resources: dict[str, float] | None, retries: int
) -> Iterator[UnitRecord]:
    """Submit all captures to the cluster; yields their records as they end, and retries after a death."""
    import distributed

    def submit(unit: Unit, attempt: int) -> Any:
        future = client.submit(units.run, unit, request, attempt, pure=False, resources=resources)
        running[future] = unit, attempt
        return future

    # workers that join later use the settings they were started with
    client.run(resource_limits.set_limits, request.threads, request.memory_gb)
    running: dict[Any, tuple[Unit, int]] = {}
    before = {unit: units.read_record(unit) for unit in wanted}
    ended = distributed.as_completed([submit(unit, 1) for unit in wanted])
    for future in ended:
        unit, attempt = running.pop(future)
        if future.status == "finished":
            yield future.result()
        elif attempt <= retries:  # its worker died, or it could not be sent
            ended.add(submit(unit, attempt + 1))
        else:
            message = f"its workers died ({future.exception()}); give them more memory, or remove it from the batch"
            yield units.record_crash(unit, before[unit], " ".join(message.split()), attempt)
