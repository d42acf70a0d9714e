"""A small farm on this machine: `polcap batch` on Dask workers that come late and are killed, beside a serial run.

python tests/campaigns/dask_farm.py [--captures 40] [--kills 10] [--tiny 1000] [--seed 0]

1. The captures (320 × 240 px, one exposure; copies of four) are processed serially, by one process.
2. `--scheduler local` with one worker and with two, one thread each: wall and CPU seconds. On a machine that others
   use too the ratio of wall seconds says little; the CPU seconds say what the second worker costs, and the seconds
   of a capture what start and end of the batch do, which no second worker halves.
3. A scheduler of its own on loopback TCP; the batch begins before any worker is there. Two workers join, one of the
   two is killed (SIGKILL) at a random moment and another takes its place, as often as asked. Every asset must be
   there and have the bytes of the serial one.
4. What a batch costs around the work: captures whose first file is no photograph, found, refused and recorded.

Prints one JSON document; exit code 1 where assets are missing or differ.
"""

import argparse
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

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.campaigns import kill, small_capture  # noqa: E402

_DISTINCT = 4  # captures that are shot; the others are copies
_PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_SPAN_S = (1.0, 8.0)  # between two kills
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
ENVIRONMENT.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed polcap is compiled: no worker does so at its start
OPTIONS = ("--estimator", "analytic", "--no-chart", "--threads", "1")
Program = subprocess.Popen[bytes]


def main(captures: int, kills: int, tiny: int, seed: int) -> int:
    """Assets that are missing or differ."""
    told: dict[str, Any] = {"captures": captures}
    adopt()
    with tempfile.TemporaryDirectory() as place:
        root, base = Path(place) / "captures", Path(place)
        shoot(root, captures)
        told["serial"] = timed(root, base / "serial")
        wanted = products(base / "serial", captures)
        for workers in (1, 2):
            out = base / f"local{workers}"
            told[f"local, {workers}"] = timed(root, out, "--scheduler", "local", "--workers", str(workers))
            told[f"local, {workers}"]["capture_s"] = capture_seconds(out)
            told[f"local, {workers}"]["differ"] = different(wanted, products(out, captures))
            shutil.rmtree(out)
        told["wall, 1 worker over 2"] = round(told["local, 1"]["wall_s"] / told["local, 2"]["wall_s"], 2)
        told["killed"] = killed(root, base / "killed", kills, np.random.default_rng(seed))
        told["killed"]["differ"] = different(wanted, products(base / "killed", captures))
        if tiny:
            told["around the work"] = around(base, tiny)
    print(json.dumps(told, indent=1))
    return sum(part["differ"] for part in told.values() if isinstance(part, dict) and "differ" in part)


def adopt() -> None:
    """Processes whose parent has ended are this one's from now on, and so are their CPU seconds."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def shoot(root: Path, captures: int) -> None:
    """The captures, capture000 …"""
    for number in range(captures):
        folder = root / f"capture{number:03d}"
        if number < _DISTINCT:
            small_capture.write(folder, number)
        else:
            shutil.copytree(root / f"capture{number % _DISTINCT:03d}", folder)


def batch(root: Path, out: Path, *more: str) -> Program:
    command = [sys.executable, "-m", "polcap", "batch", str(root), "--out", str(out), *OPTIONS, *more]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def timed(root: Path, out: Path, *more: str) -> dict[str, Any]:
    """Wall and CPU seconds of a batch with all its processes, and how it ended."""
    before, start = os.times(), time.monotonic()
    code = batch(root, out, *more).wait()
    seconds = time.monotonic() - start
    with suppress(ChildProcessError):  # until all are gone that were left to this process
        while True:
            os.wait()
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return {"wall_s": round(seconds, 1), "cpu_s": round(spent, 1), "exit": code}


def capture_seconds(out: Path) -> float:
    """Mean of the wall seconds of a capture: what start and end of the batch cost is not in it."""
    taken = [json.loads(file.read_text(encoding="utf-8"))["seconds"] for file in out.rglob("records/*.json")]
    return round(float(np.mean(taken)), 3)


def products(out: Path, captures: int) -> list[dict[str, str]]:
    """Digests of every capture's files, without what tells the time."""
    return [kill.digests(out / f"capture{number:03d}") for number in range(captures)]


def different(wanted: list[dict[str, str]], found: list[dict[str, str]]) -> int:
    """Captures whose result lacks a file, has one more, or other bytes."""
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
    options = ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show"]
    program = dask(*options)
    for _ in range(600):
        with socket.socket() as asked:
            if asked.connect_ex(("127.0.0.1", port)) == 0:
                return f"tcp://127.0.0.1:{port}", program
        time.sleep(0.2)
    raise AssertionError("no scheduler began")


def worker(address: str) -> Program:
    return dask("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "300")


def dask(*options: str) -> Program:
    command = [sys.executable, "-m", "dask", *options]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def around(base: Path, tiny: int) -> dict[str, Any]:
    """CPU of a batch of captures that cannot be read, per capture, its start included."""
    root = base / "tiny"
    for number in range(tiny):
        for angle in (0, 45, 90):
            folder = root / f"capture{number:04d}" / f"pol{angle:03d}"
            folder.mkdir(parents=True)
            (folder / "IMG_0001.DNG").write_bytes(b"no photograph")
    told = timed(root, base / "tiny-out")
    return {**told, "captures": tiny, "cpu_ms_each": round(1000 * told["cpu_s"] / tiny, 1)}


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    for name, usual in (("captures", 40), ("kills", 10), ("tiny", 1000), ("seed", 0)):
        arguments.add_argument(f"--{name}", type=int, default=usual)
    given = arguments.parse_args()
    sys.exit(1 if main(given.captures, given.kills, given.tiny, given.seed) else 0)
