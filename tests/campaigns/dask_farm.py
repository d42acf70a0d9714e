"""A small farm on this machine: `polcap batch` on Dask workers that come late and are killed, and a serial run.

python -m tests.campaigns.dask_farm [--captures 40] [--kills 10] [--tiny 1000] [--seed 0]

1. One process processes the captures (320 × 240 px, one exposure; copies of four).
2. `--scheduler local` with one worker and with two, one thread each: wall and CPU seconds. On a busy machine the ratio
   of wall seconds means little; CPU seconds give the cost of the second worker, and the seconds of a capture exclude
   start and end of the batch, which no second worker halves.
3. A scheduler on loopback TCP; the batch begins before any worker. Two workers join; again and again one of the two is
   killed (SIGKILL) at a random moment and replaced. Every asset must have the bytes of the serial one.
4. The cost of a batch without its work: captures with a file that is no photograph, found, refused and recorded.

Prints one JSON document; exit code 1 where assets are missing or differ.
"""

import ctypes
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaigns import kill
from tests.experiments import arguments, processor_s, small_capture

_DISTINCT = 4  # captures that are shot; the others are copies
_PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_SPAN_S = (1.0, 8.0)  # between two kills
OPTIONS = ("--estimator", "analytic", "--no-chart", "--threads", "1")
Program = subprocess.Popen[bytes]


def main(captures: int, kills: int, tiny: int, seed: int) -> int:
    """Assets that are missing or differ."""
    measured: dict[str, Any] = {"captures": captures}
    adopt()
    with tempfile.TemporaryDirectory() as place:
        root, base = Path(place) / "captures", Path(place)
        shoot(root, captures)
        measured["serial"] = timed(root, base / "serial")
        wanted = products(base / "serial", captures)
        for workers in (1, 2):
            out = base / f"local{workers}"
            measured[f"local, {workers}"] = timed(root, out, "--scheduler", "local", "--workers", str(workers))
            measured[f"local, {workers}"]["capture_s"] = capture_seconds(out)
            measured[f"local, {workers}"]["differ"] = different(wanted, products(out, captures))
            shutil.rmtree(out)
        measured["wall, 1 worker over 2"] = round(measured["local, 1"]["wall_s"] / measured["local, 2"]["wall_s"], 2)
        measured["killed"] = killed(root, base / "killed", kills, np.random.default_rng(seed))
        measured["killed"]["differ"] = different(wanted, products(base / "killed", captures))
        if tiny:
            measured["around the work"] = around(base, tiny)
    print(json.dumps(measured, indent=1))
    return sum(part["differ"] for part in measured.values() if isinstance(part, dict) and "differ" in part)


def adopt() -> None:
    """Make this process the parent of orphaned processes, so that their CPU seconds are counted."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def shoot(root: Path, captures: int) -> None:
    """The captures, capture000 …"""
    for number in range(captures):
        folder = root / f"capture{number:03d}"
        if number < _DISTINCT:
            small_capture(folder, number)
        else:
            shutil.copytree(root / f"capture{number % _DISTINCT:03d}", folder)


def batch(root: Path, out: Path, *more: str) -> Program:
    return kill.start("polcap", "batch", str(root), "--out", str(out), *OPTIONS, *more)


def timed(root: Path, out: Path, *more: str) -> dict[str, Any]:
    """Wall and CPU seconds of a batch with all its processes, and how it ended."""
    before, start = processor_s(), time.monotonic()
    code = batch(root, out, *more).wait()
    seconds = time.monotonic() - start
    with suppress(ChildProcessError):  # until all are gone that were left to this process
        while True:
            os.wait()
    return {"wall_s": round(seconds, 1), "cpu_s": round(processor_s() - before, 1), "exit": code}


def capture_seconds(out: Path) -> float:
    """Mean wall seconds of a capture, without start and end of the batch."""
    taken = [json.loads(file.read_text(encoding="utf-8"))["seconds"] for file in out.rglob("records/*.json")]
    return round(float(np.mean(taken)), 3)


def products(out: Path, captures: int) -> list[dict[str, str]]:
    """Digests of every capture's files, without measured times."""
    return [kill.digests(out / f"capture{number:03d}") for number in range(captures)]


def different(wanted: list[dict[str, str]], found: list[dict[str, str]]) -> int:
    """Number of captures with a missing, additional or different file."""
    return sum(not one or one != other for one, other in zip(wanted, found, strict=True))


def killed(root: Path, out: Path, kills: int, random: np.random.Generator) -> dict[str, Any]:
    """The batch on workers that join late and are killed."""
    address, scheduler = started_scheduler()
    running = batch(root, out, "--scheduler", address, "--retries", str(kills + 1))
    time.sleep(float(random.uniform(*_SPAN_S)))  # the batch waits without workers
    workers = [worker(address) for _ in range(2)]
    done = 0
    while done < kills and running.poll() is None:
        time.sleep(float(random.uniform(*_SPAN_S)))
        if running.poll() is None:
            victim = int(random.integers(2))
            workers[victim].kill()
            workers[victim].wait()
            workers[victim] = worker(address)
            done += 1
    code = running.wait()
    for program in (*workers, scheduler):
        program.kill()
        program.wait()
    return {"kills": done, "exit": code}


def started_scheduler() -> tuple[str, Program]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    where = ["--host", "127.0.0.1", "--port", str(port)]
    program = kill.start("dask", "scheduler", *where, "--no-dashboard", "--no-show")
    for _ in range(600):
        with socket.socket() as asked:
            if asked.connect_ex(("127.0.0.1", port)) == 0:
                return f"tcp://127.0.0.1:{port}", program
        time.sleep(0.2)
    raise AssertionError("no scheduler began")


def worker(address: str) -> Program:
    options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "300")
    return kill.start("dask", "worker", address, *options)


def around(base: Path, tiny: int) -> dict[str, Any]:
    """CPU of a batch of captures that cannot be read, per capture, its start included."""
    root = base / "tiny"
    for number in range(tiny):
        for angle in (0, 45, 90):
            folder = root / f"capture{number:04d}" / f"pol{angle:03d}"
            folder.mkdir(parents=True)
            (folder / "IMG_0001.DNG").write_bytes(b"no photograph")
    measured = timed(root, base / "tiny-out")
    return {**measured, "captures": tiny, "cpu_ms_each": round(1000 * measured["cpu_s"] / tiny, 1)}


if __name__ == "__main__":
    stated = arguments(__doc__, captures=40, kills=10, tiny=1000, seed=0)
    sys.exit(1 if main(stated.captures, stated.kills, stated.tiny, stated.seed) else 0)
