"""Batch processing: all captures below a folder, with one summary; a failed capture does not stop the others.

`capture_search` finds the captures, `shards` selects those of this process, `unit` processes one capture, `cluster`
those of several machines, and `contact_sheet` writes the summary. A capture that is processed again continues from its
stage cache.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

from polcap.batch import capture_search, contact_sheet
from polcap.batch import unit as units
from polcap.batch.capture_search import Candidate
from polcap.batch.shards import WHOLE, Shard
from polcap.batch.unit import FINISHED, FOLDER, Unit, UnitRecord
from polcap.errors import CaptureError
from polcap.formats import atomic, own_files, own_folders, text_file
from polcap.formats.capture import folder_names
from polcap.pipeline.request import Request
from polcap.process_pool import Died, Limits, ProcessPool

_DIED = (
    "its process died {attempts} times, most often from lack of memory; run fewer --workers, lower --memory, "
    "or remove it from the batch"
)


@dataclass(frozen=True)
class BatchPlan:
    """How a batch is processed: its shard, scheduler or number of processes, retries, behavior after a failure."""

    shard: Shard = WHOLE
    scheduler: str | None = None  # address of a Dask scheduler, or "local"; None: without Dask
    workers: int = 1
    retries: int = 2  # of a capture, if its process died
    keep_going: bool = True  # False: the batch stops at the first failure


def find(root: Path, out: Path | None = None) -> list[Unit]:
    """Find the captures below a folder, sorted by name; the folder may itself be one capture.

    Raises CaptureError: there is no capture.
    """
    return _units(root, out, _search(root))


def _search(root: Path) -> list[Candidate]:
    """Candidates below a root folder. Raises CaptureError: there is no such folder."""
    if not root.is_dir():
        raise CaptureError(f"{root}: no such folder; give the folder that holds the captures")
    absolute = Path(os.path.abspath(root))
    if folder_names.is_one_angle(absolute):
        raise CaptureError(f"{root}: holds one angle of a capture; give the folder of all, {absolute.parent}")
    return capture_search.search(root)


def _units(root: Path, out: Path | None, found: Sequence[Candidate]) -> list[Unit]:
    """The captures among the candidates, each once, sorted by name. Raises CaptureError: there is none."""
    folders = sorted((one.folder for one in found if not one.reason), key=Path.is_symlink, reverse=True)
    by_real_path = {os.path.realpath(folder): folder for folder in folders}  # the last counts: links come first
    captures = [_unit(root, folder, out) for folder in by_real_path.values()]
    if not captures:
        reasons = "; ".join(f"{candidate.folder}: {candidate.reason}" for candidate in found)
        nothing = "no folders pol000, pol045, …, no capture.toml, no photographs (views of a fused object do not count)"
        raise CaptureError(f"{root} holds no capture: {reasons or nothing}")
    return sorted(captures, key=lambda unit: folder_names.natural(unit.name))


def reopen(place: Path) -> list[Unit]:
    """The captures of an earlier batch. `place` was its root folder or its --out folder."""
    try:
        about = text_file.read_json(place / FOLDER / "batch.json")
        return find(Path(about["root"]), None if about["out"] is None else Path(about["out"]))
    except (OSError, ValueError, KeyError, TypeError):
        return find(place)


def _without_capture(root: Path, found: Sequence[Candidate]) -> list[str]:
    """Names of the sub-folders of a batch's root that hold neither photographs nor a result."""
    used = {candidate.folder for candidate in found}
    if root in used:  # the batch is one capture
        return []
    used |= {parent for path in used for parent in path.parents}
    others = [path for path in folder_names.children(root) if path.is_dir() and path not in used]
    unused = [path for path in others if path.name not in own_folders.OURS]
    return [
        path.name for path in unused if not any(folder_names.is_result(Path(inside)) for inside, _, _ in os.walk(path))
    ]


def _unit(root: Path, folder: Path, out: Path | None) -> Unit:
    """A capture of the batch: its name below the root, and its result folder."""
    name = folder.relative_to(root).as_posix() if folder != root else folder.resolve().name
    target = folder / own_folders.OUTPUT if out is None else out / name
    return Unit(name, str(folder), str(target), str((out or root) / FOLDER))


def run(
    root: Path, out: Path | None, request: Request, plan: BatchPlan, print_line: Callable[[str], None]
) -> dict[str, Any]:
    """Process the unfinished captures of this shard; returns the summary of the shard.

    The summary files in `polcap-batch` list all captures, including those of other shards.
    """
    candidates = _search(root)
    found = _units(root, out, candidates)
    batch_folder = Path(found[0].batch_folder)
    places = {"root": str(root.resolve()), "out": None if out is None else str(out.resolve())}
    names = [path.name for path in batch_folder.iterdir()] if batch_folder.is_dir() else []
    own_files.claim(batch_folder, names)  # without a record, a folder that holds anything is refused
    with own_files.opened(batch_folder) as own:
        for name in contact_sheet.EDITABLE:
            own.check(batch_folder / name)
        atomic.write_json(batch_folder / "batch.json", places)  # for `reopen`
        return _run(root, candidates, found, request, plan, print_line)


def _run(
    root: Path,
    candidates: Sequence[Candidate],
    found: list[Unit],
    request: Request,
    plan: BatchPlan,
    print_line: Callable[[str], None],
) -> dict[str, Any]:
    """Process the unfinished captures of this shard and write the summary files."""
    in_shard, batch_folder = plan.shard.of(found), Path(found[0].batch_folder)
    records = {unit: record for unit in in_shard if (record := units.find_finished(unit, request)) is not None}
    wanted = [unit for unit in in_shard if unit not in records]
    print_line(f"captures: {len(found)}, shard {plan.shard}: {len(in_shard)}, finished before: {len(records)}")
    for candidate in candidates:
        if candidate.reason:
            print_line(f"no capture in {candidate.folder}: {candidate.reason}")
    if empty := _without_capture(root, candidates):
        print_line(f"no capture in {', '.join(empty)}: no folders pol000, pol045, …, and no photographs")
    for folder in sorted({Path(unit.capture).parent for unit in found}):
        if len(views := folder_names.views(folder)) > 1:
            remedy = "`polcap fuse` joins them (a flat sample: `polcap material`)"
            print_line(f"{folder}: {views[0]} to {views[-1]} are views of one object; {remedy}")
    by_name = {unit.name: unit for unit in wanted}
    start = time.monotonic()
    for done, record in enumerate(_process(wanted, request, plan, print_line) if wanted else (), 1):
        records[by_name[record.name]] = record
        remaining = timedelta(seconds=round((time.monotonic() - start) / done * (len(wanted) - done)))
        message = f": {record.message}" if record.message else ""
        state = f"{done}/{len(wanted)} {record.name} {units.WORDS[record.state]} {record.seconds:.1f} s"
        print_line(f"{state}, {remaining} left{message}")
        if record.state not in FINISHED and not plan.keep_going:
            print_line("stopped at the first failure; --keep-going processes the others")
            break
    contact_sheet.write(batch_folder, found, [records.get(unit) or units.read_record(unit) for unit in found])
    return contact_sheet.summary([records.get(unit, UnitRecord(unit.name)) for unit in in_shard])


def _process(
    wanted: Sequence[Unit], request: Request, plan: BatchPlan, print_line: Callable[[str], None]
) -> Iterator[UnitRecord]:
    """Process captures on a Dask cluster, or in processes of this machine; yields their records as they end."""
    if plan.scheduler is not None:
        from polcap.batch import cluster

        yield from cluster.run(wanted, request, plan.scheduler, plan.workers, plan.retries, print_line)
        return
    before = {unit: units.read_record(unit) for unit in wanted}
    with ProcessPool(plan.workers, plan.retries, Limits(request.threads, request.memory_gb)) as pool:
        for unit, outcome in pool.run(partial(_process_unit, request), wanted):
            if isinstance(outcome, Died):
                message = _DIED.format(attempts=outcome.attempts)
                yield units.record_crash(unit, before[unit], message, outcome.attempts)
            else:
                yield outcome


def _process_unit(request: Request, unit: Unit, attempt: int) -> UnitRecord:
    return units.run(unit, request, attempt)


def status(found: Sequence[Unit]) -> dict[str, Any]:
    """Summary of all captures of a batch from their record files; nothing is processed."""
    return contact_sheet.summary([units.read_record(unit) for unit in found])


def table(summary: dict[str, Any]) -> str:
    """Summary of a batch as text: one line per capture, then the counts."""
    rows = [
        f"{units.WORDS[row['state']]:14}{row['seconds']:8.1f} s  {row['name']}  {row['says']}".rstrip()
        for row in summary["rows"]
    ]
    counts = ", ".join(f"{count} {units.WORDS[state]}" for state, count in summary["states"].items())
    return "\n".join([*rows, f"{summary['finished']} of {summary['captures']} finished ({counts})"])


def exit_code(summary: dict[str, Any]) -> int:
    """Exit code of a batch, by its worst capture: 1 a bug, 2 a failure, 3 a failed gate, 0 success."""
    states = summary["states"]
    if states.get("bug"):
        return 1
    if summary["finished"] < summary["captures"]:
        return 2
    return 3 if states.get("gates") else 0
