"""Batch processing on a Dask cluster (extra [batch]).

If a worker is lost, the scheduler passes its capture to another one, which continues from the stage cache.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from polcap.batch import unit as units
from polcap.batch import worker_start
from polcap.batch.processes import prepare
from polcap.batch.unit import ProcessOptions, Unit, UnitRecord
from polcap.errors import SettingError

_LOCAL = "local"
_SETTINGS = {  # less background work of Dask, which shares the cores with the captures
    "distributed.worker.profile.enabled": False,  # samples every thread every 10 ms; 6 % of a small capture's time
    "distributed.admin.tick.interval": "1s",  # by default 20 ms
    "distributed.admin.tick.limit": "30s",
    "distributed.nanny.pre-spawn-environ": {  # without MALLOC_TRIM_THRESHOLD_, which slows down every large array
        "OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1,
    },
    "distributed.worker.multiprocessing-method": worker_start.method(),
}  # fmt: skip


def preload(address: str) -> None:
    """Start importing the modules of local workers in the background."""
    if address == _LOCAL:
        worker_start.preload("distributed")


def run(
    wanted: Sequence[Unit],
    options: ProcessOptions,
    address: str,
    workers: int,
    retries: int,
    print_line: Callable[[str], None],
) -> Iterator[UnitRecord]:
    """Records of the units, in the order in which they end.

    `address` names a running scheduler, for example tcp://host:8786, and its workers must see the same folders;
    `local` starts one with `workers` processes on this machine. With device cuda a unit requests the resource GPU.

    Raises
    ------
    SettingError
        Dask is not installed, or no scheduler answers at the address.
    """
    preload(address)
    try:
        import dask
        import distributed
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[batch]'") from error
    resources = {"GPU": 1.0} if options.device == "cuda" else None
    with dask.config.set({"distributed.scheduler.allowed-failures": retries, **_SETTINGS}):
        try:
            target: Any = address
            if address == _LOCAL:
                target = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True, resources=resources, dashboard_address=":0"
                )
            client = distributed.Client(target, timeout="10s")
        except (OSError, TimeoutError, ValueError) as error:
            raise SettingError(f"--scheduler {address}: no scheduler answers there ({error}); start one") from error
        try:
            print_line(f"dashboard {client.dashboard_link}")
            yield from _gather(client, wanted, options, resources, retries)
        finally:
            client.close()
            if address == _LOCAL:
                target.close()


def _gather(
    client: Any, wanted: Sequence[Unit], options: ProcessOptions, resources: dict[str, float] | None, retries: int
) -> Iterator[UnitRecord]:
    import distributed

    attempts = dict.fromkeys(wanted, 1)
    client.run(prepare, options)  # workers that join later use the settings they were started with
    running = {client.submit(units.run, unit, options, pure=False, resources=resources): unit for unit in wanted}
    ended = distributed.as_completed(list(running))
    for future in ended:
        unit = running.pop(future)
        if future.status == "finished":
            yield future.result()
        elif attempts[unit] <= retries:  # its worker died, or it could not be sent
            attempts[unit] += 1
            again = client.submit(units.run, unit, options, attempts[unit], pure=False, resources=resources)
            running[again] = unit
            ended.add(again)
        else:
            message = f"its workers died ({future.exception()}); give them more memory, or remove it from the batch"
            yield units.crashed(unit, " ".join(message.split()), attempts[unit])
