"""How often `polcap check` is right on simulated captures, half of which have one planted fault.

python tests/benchmarks/bench_check.py FOLDER [--good 20] [--faulty 20] [--first-seed 100] [--width 640]
python tests/benchmarks/bench_check.py FOLDER --large

FOLDER keeps the captures, outside the repository. Prints a table and the score in Markdown; with --large the seconds
and the memory of the whole command on a 3 × 3 capture of 24 MP: rendered at 1500 px, enlarged before the sensor.
"""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import cv2
import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap import check, pipeline
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats import capture as captures
from polcap.synth.shooting import Shoot, Studio, Take, random_scene
from tests import faulty


def main() -> None:
    parse = argparse.ArgumentParser()
    parse.add_argument("folder", type=Path)
    parse.add_argument("--good", type=int, default=20)
    parse.add_argument("--faulty", type=int, default=20)
    parse.add_argument("--first-seed", type=int, default=100)
    parse.add_argument("--width", type=int, default=640)
    parse.add_argument("--only", default="", help="one kind of fault")
    parse.add_argument("--large", action="store_true")
    told = parse.parse_args()
    if told.large:
        large(told.folder / "24mp")
        return
    kinds = list(faulty.FAULTS)
    plan = ["" for _ in range(told.good)] + [kinds[i % len(kinds)] for i in range(told.faulty)]
    network = pipeline.load_network(None, None, "cpu", 2)
    print("| seed | planted | | said | because of | right |\n| --- | --- | --- | --- | --- | --- |")
    verdicts = reasons = asked = 0
    for seed, fault in enumerate(plan, told.first_seed):
        if told.only and fault != told.only:
            continue
        place = told.folder / f"{seed}-{fault or 'good'}-{told.width}"
        note = place / "planted.txt"
        if not note.exists():
            note.parent.mkdir(parents=True, exist_ok=True)
            note.write_text(faulty.shoot(place, seed, fault, told.width))
        said, because, figures = judge(place, network)
        right = (said == "keep") == (not fault)
        reason = right and (not fault or not faulty.FAULTS[fault] or bool(set(because) & set(faulty.FAULTS[fault])))
        asked, verdicts, reasons = asked + 1, verdicts + right, reasons + reason
        done = note.read_text() if fault else ""
        mark = "yes" if reason else "verdict only" if right else "NO"
        print(f"| {seed} | {fault} | {done} | {said} | {'; '.join(figures)} | {mark} |", flush=True)
    print(f"\nright verdict {verdicts} of {asked}, for the right reason {reasons} of {asked}")


def judge(place: Path, network: object) -> tuple[str, list[str], list[str]]:
    """What is said, the lines that say it, and their words."""
    try:
        known = captures.read(place)
        verdict = check.inspect(known, network, Config(), pipeline.load_mask_network(2))  # type: ignore[arg-type]
        (place.parent / f"{place.name}.json").write_text(json.dumps(check.shown(verdict), indent=1))
    except InputError as error:
        return "bad input", [], [str(error).replace(str(place), "…")[:90]]
    bad = [line for line in verdict.lines if line.state == "fail"]
    return "keep" if verdict.keep else "reshoot", [b.name for b in bad], [f"{b.name}: {b.says[:70]}" for b in bad]


def large(place: Path) -> None:
    """Seconds and memory of `polcap check` as a shell runs it."""
    if not place.exists():
        studio = Studio(random_scene(1, "vase"), Shoot(width=1500, height=1000, samples=1))
        radiance = {angle: studio.through(angle) for angle in (0, 45, 90)}
        studio.shoot = msgspec.structs.replace(studio.shoot, width=6000, height=4000)
        studio.buffer = replace(studio.buffer, mask=np.repeat(np.repeat(studio.buffer.mask, 4, 0), 4, 1))
        for k, (angle, small) in enumerate(radiance.items()):
            light = cv2.resize(small.astype(np.float32), (6000, 4000), interpolation=cv2.INTER_CUBIC)
            for e in range(3):
                file = place / f"pol{angle:03d}" / f"IMG_{3 * k + e + 1:04d}.DNG"
                file.parent.mkdir(parents=True, exist_ok=True)
                studio.photograph(file, np.maximum(light, 0), Take(k, e, 4.0 ** (e - 1)))
    size = sum(file.stat().st_size for file in place.rglob("*.DNG"))
    start, busy = perf_counter(), os.getloadavg()[0]
    child = subprocess.Popen([sys.executable, "-m", "polcap", "check", place])
    _, status, used = os.wait4(child.pid, 0)
    print(
        f"{size / 1e6:.0f} MB of RAW: {perf_counter() - start:.1f} s, {used.ru_utime + used.ru_stime:.1f} s of CPU, "
        f"largest process {used.ru_maxrss / 1e6:.2f} GB, exit {os.waitstatus_to_exitcode(status)}, "
        f"load before {busy:.1f} on {os.cpu_count()} cores"
    )


if __name__ == "__main__":
    main()
