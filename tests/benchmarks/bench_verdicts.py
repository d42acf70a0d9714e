"""Benchmark of the gates: how often `check` and `process` judge simulated good and faulty captures correctly.

python tests/benchmarks/bench_verdicts.py FOLDER [--captures 49] [--first-seed 300] [--only KIND] [--width PX]
python tests/benchmarks/bench_verdicts.py FOLDER --seeds 301,307
python tests/benchmarks/bench_verdicts.py FOLDER --only good --meshes $POLCAP_DATA/meshes/train --width 640
python tests/benchmarks/bench_verdicts.py FOLDER --tally

A seed says everything: good or which fault, angles, light, look, size (0.3 to 0.6 MP unless --width). Of 49 in a row 21
are good, each of the 20 kinds of fault comes once and eight come twice. `process` is the whole path with the shipped
networks, and the option that `check` says it needs, up to its gates. FOLDER/rows.jsonl gains a line per capture, so
that a run goes on where it ended; the captures themselves are removed unless --keep. Prints the shares: kept, passed,
contradictions, found, rightly named, and of faults that passed whether the expected error was raised above the actual
one.
"""

import argparse
import json
import shutil
import sys
import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from plant_captures import FAULTS, shoot

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.pipeline import check, models, path
from polcap.pipeline.cache import MemoryCache
from polcap.quality import gates
from polcap.quality.gate_values import full_size
from polcap.results import Results
from polcap.stage_values import Network, SurfaceMaps

Row = dict[str, Any]

WIDTHS = (640, 704, 768, 832, 896)  # RAW px, 4:3
_OFTEN = ("ambient light", "lossy", "cut file", "wrong focal", "no chart", "glossy chart", "flash by shutter", "wax")
_BAD = (*FAULTS, *_OFTEN)
PLAN = tuple(_BAD[n * 4 // 7] if n % 7 in (0, 2, 4, 6) else "" for n in range(49))  # "": good


def main() -> None:
    parse = argparse.ArgumentParser()
    parse.add_argument("folder", type=Path)
    parse.add_argument("--captures", type=int, default=49)
    parse.add_argument("--first-seed", type=int, default=300)
    parse.add_argument("--seeds", default="", help="instead of a row of them")
    parse.add_argument("--width", type=int, default=0)
    parse.add_argument("--only", help="a kind of fault, or good")
    parse.add_argument("--meshes", type=Path, help="folder of objects, instead of bumps, clusters and vases")
    parse.add_argument("--keep", action="store_true")
    parse.add_argument("--tally", action="store_true")
    given = parse.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    log = given.folder / "rows.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    done = {(row["seed"], row["width"]) for row in rows}
    seeds = range(given.first_seed, given.first_seed + given.captures * (not given.tally))
    for seed in [int(one) for one in given.seeds.split(",")] if given.seeds else seeds:
        kind, width = PLAN[seed % len(PLAN)], given.width or WIDTHS[seed // 7 % len(WIDTHS)]
        if (given.only and (kind or "good") != given.only) or (seed, width) in done:
            continue
        row = one(given.folder, seed, kind, width, given.keep, given.meshes)
        rows.append(row)
        with log.open("a") as out:
            out.write(json.dumps(row) + "\n")
        print(f"{seed} {kind or 'good':24}{row['check']:5}{row['process']:5} {mark(row):6}{spoken(row)}", flush=True)
    tally(rows)


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
        row |= judge_check(capture) | judge_process(capture, place)
        if row["needs"]:
            row |= judge_process(capture, place, no_chart=True)
    if not keep:
        shutil.rmtree(place)
    return row | {"seconds": round(time.process_time() - start, 1)}


def judge_check(capture: Capture) -> Row:
    try:
        found = check.inspect(capture, Config(), networks=networks)
    except InputError as error:
        return {"check": "fail", "check_gates": {_name(error): ["fail", None, 45.0]}, "needs": ""}
    return {"check": gates.verdict(found.lines), "check_gates": _shown(found.lines), "needs": found.needs}


def judge_process(capture: Capture, place: Path, no_chart: bool = False) -> Row:
    """The verdict; the expected error of the normals with all costs, and the actual one (medians, degrees)."""
    chart = ChartRequest("none" if no_chart else "auto")
    try:
        found = path.path(capture, path.UserInput(chart, None, *networks()), Config(), MemoryCache(), Results)
        lines = gates.judge(full_size(found, capture.focal_doubt), Config().gates)
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
    truth = np.load(place / "normals.npz")
    step, (x0, y0) = round(maps.view.scale), (round(at) for at in maps.view.origin)
    height, width = maps.mask.shape
    cut = np.s_[step * y0 : step * (y0 + height), step * x0 : step * (x0 + width)]
    normal = truth["normal"][cut].astype(np.float32).reshape(height, step, width, step, 3).sum((1, 3))
    seen = truth["mask"][cut].reshape(height, step, width, step).all((1, 3)) & maps.mask
    if not seen.any():
        return None
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    cosine = np.clip((normal * maps.normal).sum(-1)[seen], -1, 1)
    return round(float(np.median(np.degrees(np.arccos(cosine)))), 2)


def tally(rows: list[Row]) -> None:
    good, bad = ([row for row in rows if bool(row["kind"]) == faulty] for faulty in (False, True))
    against = [row for row in rows if (row["check"] == "fail") != (row["process"] == "fail")]
    print(f"\ngood {len(good)}: kept by check {_count(good, 'check')}, passed by process {_count(good, 'process')}")
    print(f"   spoken to though passed: {dict(Counter(g for row in good for g in speaking(row)))}")
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
    named = speaking(row)
    if any(word in name for name in named for word in FAULTS[row["kind"]]):
        return "named"
    return "found" if named else "NO"


def speaking(row: Row) -> set[str]:
    """Gates that fail, or warn of more than what was arranged: a doubtful mask, no chart and what follows from it."""
    usual = {"mask"} | ({"chart", "gain doubt"} if row["chart"] == "none" and not row["kind"] else set())
    every = [*row["check_gates"].items(), *row["process_gates"].items()]
    return {name for name, (state, *_) in every if state == "fail" or (state == "warn" and name not in usual)}


def spoken(row: Row) -> str:
    return f"{'; '.join(sorted(speaking(row)))} | {row['expected']}° {row['actual']}° | {row['seconds']} s"


@cache
def networks() -> tuple[Network | None, Network | None]:
    return models.load_network(None, None, "cpu", 1), models.load_mask_network(1)


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
