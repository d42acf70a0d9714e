"""Benchmark of speed: CPU seconds of each stage and of whole runs, against the unavoidable time of the libraries.

    python tests/benchmarks/bench_speed.py FOLDER [--megapixels 6,24] [--out speed.json]

Captures of 3 angles × 3 exposures are made below FOLDER where they are missing. The floor of the same run is
LibRaw's unpacking of the same files on two processes, one copy of the merged picture (a read and a write at
memory bandwidth), the bare call of the network on the object's crop, and the encoding of the pictures of the
result with the same libraries. Seconds are user + system time of the whole process tree, so that a busy machine
is no slow one; the ratios are compared. Writes speed.json and speed.md, and adds a line to
tests/benchmarks/speed_history.jsonl.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it, before NumPy is imported

import argparse
import json
import platform
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from polcap import __version__
from polcap.config import Config
from polcap.errors import GateError
from polcap.formats import onnx
from polcap.formats.capture import reader as captures
from polcap.formats.maps import exr, png
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput

HISTORY = Path(__file__).with_name("speed_history.jsonl")
TICK = os.sysconf("SC_CLK_TCK")


@dataclass
class Bench:
    """One size of capture, measured."""

    megapixels: float
    floor: dict[str, float] = field(default_factory=dict)  # CPU s
    cold: dict[str, float] = field(default_factory=dict)  # CPU s by stage
    wall: dict[str, float] = field(default_factory=dict)  # s, of cold and warm
    again: float = 0.0  # CPU s of a first run of the command on that result: stages are cached, outputs are written
    warm: float = 0.0  # CPU s of the next: nothing changed
    peak_mb: float = 0.0  # anonymous memory of the process tree, shared parts counted once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--megapixels", default="6,24")
    parser.add_argument("--out", type=Path, default=Path("speed.json"))
    options = parser.parse_args()
    rows = [measure(options.folder, float(size)) for size in options.megapixels.split(",")]
    start = cpu_of([sys.executable, "-m", "polcap", "--help"])
    document = {
        "polcap": __version__,
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "help_cpu_s": round(start, 3),
        "sizes": [shown(row) for row in rows],
    }
    options.out.write_text(json.dumps(document, indent=1) + "\n")
    options.out.with_suffix(".md").write_text(table(rows, start))
    with HISTORY.open("a") as history:
        ratios = {f"{row.megapixels:g}": round(ratio(row), 2) for row in rows}
        history.write(json.dumps({"polcap": __version__, "time": time.strftime("%F"), "ratio": ratios}) + "\n")
    print(table(rows, start))


def measure(folder: Path, megapixels: float) -> Bench:
    capture = made(folder, megapixels)
    out = folder / f"out{megapixels:g}"
    row = Bench(megapixels)
    shutil.rmtree(out, ignore_errors=True)
    with watched(row):  # a run of its own: reading the memory delays the run
        processed(capture, out)
    shutil.rmtree(out, ignore_errors=True)
    row.wall["cold"], row.cold = processed(capture, out)
    command = [sys.executable, "-m", "polcap", "process", str(capture), "--out", str(out)]
    row.again, row.warm = cpu_of(command), cpu_of(command)
    row.floor = floor(capture, out)
    return row


def made(folder: Path, megapixels: float) -> Path:
    """A synthetic capture of about that many pixels, 3:2."""
    capture = folder / f"cap{megapixels:g}"
    if not capture.exists():
        width = round((megapixels * 1.5e6) ** 0.5 / 4) * 4
        sides = ["--set", f"width={width}", "--set", f"height={width * 2 // 3 // 2 * 2}", "--set", "samples=1"]
        subprocess.run([sys.executable, "-m", "polcap", "synth", str(capture), *sides], check=True)
    return capture


def processed(capture: Path, out: Path) -> tuple[float, dict[str, float]]:
    """Wall seconds and CPU seconds by stage; `start` is reading the capture and the network."""
    begun, by_stage, last = time.monotonic(), {}, tree_cpu()
    network, finder = models.load_network("network", None, "cpu", 0), models.load_mask_network()
    found = captures.read(capture)
    by_stage["start"] = tree_cpu() - last

    def progress(stage: str, seconds: float | None, cached: bool) -> None:
        nonlocal last
        if seconds is None:
            last = tree_cpu()
        elif not cached:
            by_stage[stage] = tree_cpu() - last

    pipeline.process(found, UserInput(network=network, mask_network=finder), Config(), out, progress=progress)
    return time.monotonic() - begun, by_stage


# ---------------------------------------------------------------- the floor


def floor(capture: Path, out: Path) -> dict[str, float]:
    files = sorted(str(file) for file in capture.rglob("*.DNG"))
    with get_context("spawn").Pool(2) as pool:
        pool.map(idle, range(2))
        started = tree_cpu()
        pool.map(unpack, files, chunksize=1)
        unpacking = tree_cpu() - started
    stack = np.load(next(out.glob("work/01-hdr/value.value.npy")), mmap_mode="r")
    held = np.ascontiguousarray(stack)
    network = models.load_network("network", None, "cpu", 0)
    assert network is not None
    maps = json.loads((out / "maps" / "maps.json").read_text())
    shrink = max(1.0, max(maps["size"]) / int(network.metadata["native_size"]))
    multiple = int(network.metadata["size_multiple"])
    width, height = (-(-round(side / shrink) // multiple) * multiple for side in maps["size"])
    blank = np.zeros((1, len(network.channels), height, width), np.float32)
    return {
        "unpack": unpacking,
        "copy": spent(lambda: held.copy()) * 2,  # value and variance
        "network": spent(lambda: onnx.run(network, blank)),
        "encode": encoding(out),
    }


def idle(_: int) -> None:
    """Lets a child start."""


def unpack(file: str) -> float:
    import rawpy

    with rawpy.imread(file) as raw:
        return float(raw.raw_image_visible[0, 0])


def encoding(out: Path) -> float:
    """The same pictures once more, from memory."""
    total, again = 0.0, out / "work" / "again.exr"
    for file in sorted([*out.glob("maps/*.png"), *out.glob("asset/*.png")]):
        picture = png.read(file)
        total += spent(partial(png.encode, picture))
    for file in sorted([*out.glob("maps/*.exr"), *out.glob("asset/*.exr")]):
        channels = exr.read(file)
        half = file.stem not in ("normal", "depth")
        total += spent(partial(exr.write, again, channels, half=half))
        again.unlink()
    return total


# ---------------------------------------------------------------- measuring


def spent(work: Callable[[], Any]) -> float:
    """CPU seconds of a call in this process."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def cpu_of(command: list[str]) -> float:
    before = os.times()
    code = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
    if code not in (0, GateError.exit_code):  # a capture that grew knows its alignment to fewer of its pixels
        raise subprocess.CalledProcessError(code, command)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def tree() -> Iterator[Path]:
    """/proc of this process and all below it."""
    parents = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(place.name)] = int((place / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    for pid in parents:
        above = pid
        while above in parents and above != os.getpid():
            above = parents[above]
        if above == os.getpid():
            yield Path("/proc") / str(pid)


def tree_cpu() -> float:
    """User and system seconds of this process and its children, the dead ones too."""
    total = 0
    for place in tree():
        try:
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += sum(int(ticks) for ticks in fields[11:15])
    return total / TICK


@contextmanager
def watched(row: Bench) -> Iterator[None]:
    """Note the greatest memory meanwhile."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(0.3):
            row.peak_mb = max(row.peak_mb, anonymous_mb())

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def anonymous_mb() -> float:
    """Anonymous memory of the process tree, shared parts counted once, MB."""
    total = 0
    for place in tree():
        try:
            lines = (place / "smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith(("Pss_Anon", "Pss_Shmem")))
    return total / 1000


# ---------------------------------------------------------------- output


def ratio(row: Bench) -> float:
    return sum(row.cold.values()) / sum(row.floor.values())


def shown(row: Bench) -> dict[str, Any]:
    rounded = {name: {k: round(v, 3) for k, v in getattr(row, name).items()} for name in ("floor", "cold", "wall")}
    totals = {
        "ratio": round(ratio(row), 3),
        "keys_compared_cpu_s": round(row.again, 3),
        "warm_cpu_s": round(row.warm, 3),
        "peak_mb": round(row.peak_mb),
        "mb_per_megapixel": round(row.peak_mb / row.megapixels, 1),
    }
    return {"megapixels": row.megapixels, **rounded, **totals}


def table(rows: list[Bench], start: float) -> str:
    """Markdown."""
    heads = [f"{row.megapixels:g} MP" for row in rows]
    lines = ["| CPU s | " + " | ".join(heads) + " |", "| --- |" + " --- |" * len(rows)]
    for part in ("floor", "cold"):
        for name in getattr(rows[0], part):
            cells = " | ".join(f"{getattr(row, part).get(name, 0):.2f}" for row in rows)
            lines.append(f"| {'floor: ' if part == 'floor' else ''}{name} | {cells} |")
    for name, of in (
        ("**floor**", lambda row: sum(row.floor.values())),
        ("**whole, cold**", lambda row: sum(row.cold.values())),
        ("whole / floor", ratio),
        ("all results cached, outputs written again", lambda row: row.again),
        ("nothing changed", lambda row: row.warm),
        ("peak memory, MB", lambda row: row.peak_mb),
    ):
        lines.append(f"| {name} | " + " | ".join(f"{of(row):.2f}" for row in rows) + " |")
    if len(rows) > 1:
        first, last = rows[0], rows[-1]
        grown = np.log(sum(last.cold.values()) / sum(first.cold.values()))
        lines.append(f"\ntime ~ megapixels^{grown / np.log(last.megapixels / first.megapixels):.2f}")
    return "\n".join([*lines, f"\n`polcap --help`: {start:.2f} s\n"])


if __name__ == "__main__":
    main()
