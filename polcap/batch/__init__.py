"""In: a folder of captures. Out: their results, whatever breaks on the way, and one summary of all.

Every capture is an idempotent unit. `shards` says which of them are this process's, `unit` does one, `processes`
or `cluster` many at a time, `sheet` sums up, `job_files` hands the shards to a farm.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polcap.batch import sheet
from polcap.batch import unit as units
from polcap.batch.shards import WHOLE, Shard
from polcap.batch.unit import FINISHED, FOLDER, Order, Record, Unit
from polcap.errors import CaptureError
from polcap.formats import atomic, own_folders
from polcap.formats.capture import layouts

Tell = Callable[[str], None]


@dataclass(frozen=True)
class How:
    """Who does the work."""

    shard: Shard = WHOLE
    scheduler: str | None = None  # address of a Dask scheduler, or "local"; None: processes of this machine
    workers: int = 1
    retries: int = 2  # of a capture whose process died
    keep_going: bool = True  # False: the first failure ends the batch


def find(root: Path, out: Path | None = None) -> list[Unit]:
    """The captures below a folder, by name; one capture's folder is a batch of one.

    Raises
    ------
    CaptureError
        There is none.
    """
    if not root.is_dir():
        raise CaptureError(f"{root}: no such folder; give the folder that holds the captures")
    desk = str((out or root) / FOLDER)
    found = [_unit(root, Path(folder), out, desk) for folder in _captures(root)]
    if not found:
        raise CaptureError(f"{root}: holds no capture: no folder of pol000, pol045, …, no capture.toml, no photographs")
    return sorted(found, key=lambda unit: layouts.natural(unit.name))


def reopen(place: Path) -> list[Unit]:
    """The units of a batch that ran with this folder as its root or its --out."""
    return find(*_places(place))


def _places(place: Path) -> tuple[Path, Path | None]:
    try:
        about = json.loads((place / FOLDER / "batch.json").read_text(encoding="utf-8"))
        return Path(about["root"]), None if about["out"] is None else Path(about["out"])
    except (OSError, ValueError, KeyError, TypeError):
        return place, None


def _captures(root: Path) -> Iterator[str]:
    for folder, inside, files in os.walk(root):
        if layouts.looks_like_a_capture(Path(folder), inside, files):
            inside.clear()
            yield folder
        else:
            inside[:] = [name for name in inside if not name.startswith(".") and name not in own_folders.OURS]


def _unit(root: Path, folder: Path, out: Path | None, desk: str) -> Unit:
    name = folder.relative_to(root).as_posix() if folder != root else folder.resolve().name
    target = folder / own_folders.OUTPUT if out is None else out / name
    return Unit(name, str(folder), str(target), desk)


def run(root: Path, out: Path | None, order: Order, how: How, tell: Tell) -> dict[str, Any]:
    """Process the captures of this shard that are not finished; returns the summary of the shard.

    The summary files in `polcap-batch` tell of all captures, those of other shards too.
    """
    found = find(root, out)
    mine = how.shard.of(found)
    desk = Path(found[0].desk)
    with atomic.path(desk / "batch.json") as temporary:  # what `polcap status` needs when --out is given
        places = {"root": str(root.resolve()), "out": None if out is None else str(out.resolve())}
        temporary.write_text(json.dumps(places) + "\n", encoding="utf-8")
    records = {unit: record for unit in mine if (record := units.finished(unit, order)) is not None}
    wanted = [unit for unit in mine if unit not in records]
    tell(f"{len(found)} captures, shard {how.shard}: {len(mine)}, finished before: {len(records)}")
    by_name = {unit.name: unit for unit in wanted}
    start = time.monotonic()
    for record in _work(wanted, order, how, tell) if wanted else ():
        records[by_name[record.name]] = record
        done = len(records) - (len(mine) - len(wanted))
        tell(progress(record, done, len(wanted), time.monotonic() - start))
        if record.state not in FINISHED and not how.keep_going:
            tell("stopped at the first failure; --keep-going goes on with the others")
            break
    sheet.write(desk, found, [records.get(unit) or units.read_record(unit) for unit in found])
    return sheet.summary([records.get(unit, Record(unit.name)) for unit in mine])


def _work(wanted: Sequence[Unit], order: Order, how: How, tell: Tell) -> Iterator[Record]:
    if how.scheduler is not None:
        from polcap.batch import cluster

        return cluster.run(wanted, order, how.scheduler, how.workers, how.retries, tell)
    from polcap.batch import processes

    return processes.run(wanted, order, how.workers, how.retries)


def progress(record: Record, done: int, total: int, seconds: float) -> str:
    """One line: what ended, how far it all is, and how long the rest will take at this pace."""
    left = seconds / done * (total - done)
    says = f": {record.says}" if record.says else ""
    return f"{done}/{total} {record.name} {record.state} {record.seconds:.1f} s, {clock(left)} left{says}"


def clock(seconds: float) -> str:
    """h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def status(found: Sequence[Unit]) -> dict[str, Any]:
    """What is known of every capture, without doing anything."""
    return sheet.summary([units.read_record(unit) for unit in found])


def lines(summary: dict[str, Any]) -> str:
    """A line per capture, and the counts."""
    rows = [
        f"{row['state']:12}{row['seconds']:8.1f} s  {row['name']}  {row['says']}".rstrip() for row in summary["rows"]
    ]
    counts = ", ".join(f"{count} {state}" for state, count in summary["states"].items())
    return "\n".join([*rows, f"{summary['finished']} of {summary['captures']} finished ({counts})"])


def exit_code(summary: dict[str, Any]) -> int:
    """Of a batch: that of its worst capture. 1 a bug, 2 a failure, 3 a failed gate, 0 all well."""
    states = summary["states"]
    if states.get("bug"):
        return 1
    if summary["finished"] < summary["captures"]:
        return 2
    return 3 if states.get("gates") else 0
