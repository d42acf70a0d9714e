"""In: units and the address of a Dask scheduler. Out: their records (extra [batch]).

A worker that is lost takes nothing with it: the scheduler gives its capture to another, which goes on from the
stages that are stored.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from polcap.batch import unit as units
from polcap.batch import worker_start
from polcap.batch.processes import prepare
from polcap.batch.unit import Order, Record, Unit
from polcap.errors import SettingError

_LOCAL = "local"
_SETTINGS = {  # each of what Dask does beside the work takes its time from a core that works
    "distributed.worker.profile.enabled": False,  # looks into each thread every 10 ms: 6 % of small captures
    "distributed.admin.tick.interval": "1s",  # by default a look at the clock every 20 ms
    "distributed.admin.tick.limit": "30s",
    "distributed.nanny.pre-spawn-environ": {  # without MALLOC_TRIM_THRESHOLD_, which fetches every array's pages anew
        "OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1,
    },
    "distributed.worker.multiprocessing-method": worker_start.method(),
}  # fmt: skip


def begin(address: str) -> None:
    """Have what workers of this machine need imported, while the caller imports what it needs itself."""
    if address == _LOCAL:
        worker_start.begin("distributed")


def run(
    wanted: Sequence[Unit], order: Order, address: str, workers: int, retries: int, tell: Callable[[str], None]
) -> Iterator[Record]:
    """Records in the order in which units end.

    `address` is that of a running scheduler, as tcp://host:8786, whose workers see the same folders; `local`
    starts one with `workers` processes here. With device cuda a unit asks for the resource GPU.

    Raises
    ------
    SettingError
        Dask is not installed, or nobody answers at that address.
    """
    begin(address)
    try:
        import dask
        import distributed
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[batch]'") from error
    resources = {"GPU": 1.0} if order.device == "cuda" else None
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
            tell(f"dashboard {client.dashboard_link}")
            yield from _gather(client, wanted, order, resources, retries)
        finally:
            client.close()
            if address == _LOCAL:
                target.close()


def _gather(
    client: Any, wanted: Sequence[Unit], order: Order, resources: dict[str, float] | None, retries: int
) -> Iterator[Record]:
    import distributed

    attempts = dict.fromkeys(wanted, 1)
    client.run(prepare, order)  # those that join later work with what they were started with
    doing = {client.submit(units.run, unit, order, pure=False, resources=resources): unit for unit in wanted}
    landing = distributed.as_completed(list(doing))
    for future in landing:
        unit = doing.pop(future)
        if future.status == "finished":
            yield future.result()
        elif attempts[unit] <= retries:  # its workers died, or it could not be sent
            attempts[unit] += 1
            again = client.submit(units.run, unit, order, attempts[unit], pure=False, resources=resources)
            doing[again] = unit
            landing.add(again)
        else:
            why = f"lost with its workers ({future.exception()}); give them more memory, or take it out of the batch"
            yield units.crashed(unit, " ".join(why.split()), attempts[unit])
