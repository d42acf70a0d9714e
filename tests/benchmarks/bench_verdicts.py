"""Benchmark of the gates: how often `check` and `process` judge simulated good and faulty captures correctly.

python tests/benchmarks/bench_verdicts.py FOLDER [--captures 49] [--first-seed 300] [--only KIND] [--width PX]
python tests/benchmarks/bench_verdicts.py FOLDER --seeds 301,307
python tests/benchmarks/bench_verdicts.py FOLDER --only good --meshes $POLCAP_DATA/meshes/train --width 640
python tests/benchmarks/bench_verdicts.py FOLDER --tally

A seed determines a capture: good or which fault, angles, light, look, size (0.3 to 0.6 MP unless --width). Of 49 seeds
in a row 21 are good, each of the 20 kinds of fault comes once and eight come twice. --seeds replaces the row, --only
takes one kind of fault or "good", --meshes is a folder of objects. `process` is the whole path with the shipped
networks, and the option that `check` names, up to its gates. FOLDER/rows.jsonl gains a line per capture, so that a
stopped run continues; the captures are removed unless --keep. Prints the shares: accepted, passed, contradictions,
found, rightly named, and of faults that passed whether the expected error was raised above the actual one.
"""

import shutil
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from plant_captures import FAULTS, shoot

from polcap.capture_values import Capture
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.optics import frames
from polcap.optics.resize import block_means
from polcap.pipeline import check
from polcap.quality import gates
from polcap.stage_values import SurfaceMaps
from tests.experiments import Rows, arguments, judge, networks, raw_pixels

Row = dict[str, Any]

WIDTHS = (640, 704, 768, 832, 896)  # RAW px, 4:3
_OFTEN = ("ambient light", "lossy", "cut file", "wrong focal", "no chart", "glossy chart", "flash by shutter", "wax")
_BAD = (*FAULTS, *_OFTEN)
PLAN = tuple(_BAD[n * 4 // 7] if n % 7 in (0, 2, 4, 6) else "" for n in range(49))  # "": good


def main() -> None:
    options = arguments(
        __doc__, "folder", "--keep", "--tally", captures=49, first_seed=300, seeds="", width=0, only=str, meshes=Path
    )
    rows = Rows(options.folder / "rows.jsonl")
    done = rows.done("seed", "width")
    seeds = range(options.first_seed, options.first_seed + options.captures * (not options.tally))
    for seed in [int(one) for one in options.seeds.split(",")] if options.seeds else seeds:
        kind, width = PLAN[seed % len(PLAN)], options.width or WIDTHS[seed // 7 % len(WIDTHS)]
        if (options.only and (kind or "good") != options.only) or (seed, width) in done:
            continue
        row = one(options.folder, seed, kind, width, options.keep, options.meshes)
        rows.add(row)
        print(f"{seed} {kind or 'good':24}{row['check']:5}{row['process']:5} {mark(row):6}{line(row)}", flush=True)
    tally(rows.all)


def one(folder: Path, seed: int, kind: str, width: int, keep: bool, meshes: Path | None) -> Row:
    place = folder / f"{seed}-{kind.replace(' ', '-') or 'good'}-{width}"
    start = time.process_time()
    if place.exists():
        shutil.rmtree(place)
    row: Row = {"seed": seed, "kind": kind, **shoot(place, seed, kind, width, meshes)}
    try:
        capture = captures.read(place)
    except InputError as error:
        row |= {"check": "fail", "process": "fail", "check_gates": {_name(error): ["fail", None, 45.0]}}
        row |= {"process_gates": {}, "needs": "", "expected": None, "actual": None}
    else:
        row |= judge_check(capture) | judge_process(place)
        if row["needs"]:
            row |= judge_process(place, "none")
    if not keep:
        shutil.rmtree(place)
    return row | {"seconds": round(time.process_time() - start, 1)}


def judge_check(capture: Capture) -> Row:
    try:
        found = check.inspect(capture, Config(), networks=networks)
    except InputError as error:
        return {"check": "fail", "check_gates": {_name(error): ["fail", None, 45.0]}, "needs": ""}
    return {"check": gates.verdict(found.lines), "check_gates": _shown(found.lines), "needs": found.needs}


def judge_process(place: Path, chart: str = "auto") -> Row:
    """The verdict; the expected error of the normals with all costs, and the actual one (medians, degrees)."""
    try:
        found, lines = judge(place, chart=chart)
        actual = error_deg(found.maps, place)
    except InputError as error:
        return {
            "process": "fail", "process_gates": {_name(error): ["fail", None, 45.0]},
            "expected": None, "actual": None,
        }  # fmt: skip
    expected = next((line.value for line in lines if line.name == "normal error"), None)
    shown = _shown(lines)
    return {"process": gates.verdict(lines), "process_gates": shown, "expected": expected, "actual": actual}


def error_deg(maps: SurfaceMaps, place: Path) -> float | None:
    """Median angle between the normals and the truth where both see the object."""
    step, cut = raw_pixels(maps)
    with np.load(place / "normals.npz") as truth:
        normal, mask = (block_means(truth[name][cut].astype(np.float32), step) for name in ("normal", "mask"))
    error = frames.angle_deg(frames.unit(normal), maps.normal)[(mask == 1) & maps.mask]
    return round(float(np.median(error)), 2) if error.size else None


def tally(rows: list[Row]) -> None:
    good, bad = ([row for row in rows if bool(row["kind"]) == faulty] for faulty in (False, True))
    against = [row for row in rows if (row["check"] == "fail") != (row["process"] == "fail")]
    print(f"\ngood {len(good)}: accepted by check {_count(good, 'check')}, passed by process {_count(good, 'process')}")
    print(f"   complaints though passed: {dict(Counter(g for row in good for g in complaints(row)))}")
    print(f"contradictions: {[(row['seed'], row['kind'], row['check'], row['process']) for row in against]}")
    found, named = (sum(mark(row) in what for row in bad) for what in (("found", "named"), ("named",)))
    print(f"faulty {len(bad)}: found {found}, rightly named {named}")
    for kind in FAULTS:
        marks = Counter(mark(row) for row in bad if row["kind"] == kind)
        print(f"   {kind:24}{dict(marks)}")
    passed = [row for row in bad if row["process"] != "fail" and row["actual"] is not None]
    raised = [row for row in passed if row["expected"] > row["actual"]]
    print(f"faults that passed {len(passed)}: expected error above the actual one in {len(raised)}")
    for row in passed:
        if row not in raised:
            print(f"   {row['seed']} {row['kind']}: expected {row['expected']}°, actual {row['actual']}°")
    both = [row for row in good if row["actual"] is not None]
    ratio = [row["expected"] / row["actual"] for row in both]
    if ratio:
        print(f"good: actual error {np.median([r['actual'] for r in both]):.1f}°, expected over actual median")
        print(f"   {np.median(ratio):.2f}, 10 % {np.quantile(ratio, 0.1):.2f}, 90 % {np.quantile(ratio, 0.9):.2f}")


def mark(row: Row) -> str:
    """Whether a verdict is right: yes or NO of a good capture; named, found or NO of a faulty one."""
    if not row["kind"]:
        return "yes" if "fail" not in (row["check"], row["process"]) else "NO"
    named = complaints(row)
    if any(word in name for name in named for word in FAULTS[row["kind"]]):
        return "named"
    return "found" if named else "NO"


def complaints(row: Row) -> set[str]:
    """Gates that fail, or warn of more than what was arranged: a doubtful mask, no chart and what follows from it."""
    usual = {"mask"} | ({"chart", "gain doubt"} if row["chart"] == "none" and not row["kind"] else set())
    every = [*row["check_gates"].items(), *row["process_gates"].items()]
    return {name for name, (state, *_) in every if state == "fail" or (state == "warn" and name not in usual)}


def line(row: Row) -> str:
    return f"{'; '.join(sorted(complaints(row)))} | {row['expected']}° {row['actual']}° | {row['seconds']} s"


def _name(error: InputError) -> str:
    """The error's class; what it is about where that names another fault."""
    name = type(error).__name__.removesuffix("Error").lower()
    order = "order " if "contradict the polarization at the object's outline" in str(error) else ""
    exposed = " exposure" * ("well exposed" in str(error))
    return f"error {order}{name}{' chart' * ('ColorChecker' in str(error))}{exposed}"


def _shown(lines: Any) -> dict[str, list[Any]]:
    return {line.name: [line.state, line.value, line.cost_deg] for line in lines}


def _count(rows: list[Row], which: str) -> int:
    return sum(row[which] != "fail" for row in rows)


if __name__ == "__main__":
    main()
