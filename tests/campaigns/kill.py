"""kill -9 at random moments over `polcap process` and `export`; then the same command again, undisturbed.

python -m tests.campaigns.kill [--kills 30] [--seed 0] [--rows FILE]

Each round kills one `process` and one `export` of a capture of 320 × 240 px: every other round at any moment of the
command, else at any moment after it began to write. A moment is a processor time of the command, so that a busy
machine does not move it. Linux only.

After a kill every file under a final name equals that of an undisturbed run (JSON, which is written in several states,
is complete). After the repeated command all files are equal (measured times excepted), none is missing or left over,
and the photographs are unchanged.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from hashlib import blake2b
from pathlib import Path

import numpy as np

from polcap.formats import own_files
from tests.conftest import ROOT
from tests.experiments import Rows, arguments, processor_s, small_capture

_CLOCK = {"seconds", "timings", "time"}  # keys of JSON that hold measured times
_OWN = ("work/lock", "work/owner", "work/unchanged.json", "report.html", own_files.RECORD)  # times, processes, order
_POLL_S = 0.004  # between two checks whether the command writes
_ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
_ENVIRONMENT.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed polcap is compiled: no worker does so at its start
Step = tuple[str | Path, ...]


def start(*command: object) -> subprocess.Popen[bytes]:
    """Run a Python module such as polcap in a process of its own."""
    words = [sys.executable, "-m", *map(str, command)]
    return subprocess.Popen(words, env=_ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def digests(folder: Path) -> dict[str, str]:
    """Digest of every file; JSON without the measured times, and without the page that shows them."""
    found = {}
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = str(file.relative_to(folder))
        if name not in _OWN:
            data = _content(file) if file.suffix == ".json" and not _partial(name) else file.read_bytes()
            found[name] = blake2b(data or b"damaged: " + file.read_bytes(), digest_size=16).hexdigest()
    return found


def _content(file: Path) -> bytes | None:
    """Canonical bytes of a JSON file, without measured times; None if it is damaged."""
    try:
        timeless = json.loads(
            file.read_bytes(), object_pairs_hook=lambda pairs: {k: v for k, v in pairs if k not in _CLOCK}
        )
    except ValueError:
        return None
    return json.dumps(timeless, sort_keys=True).encode()


def _partial(name: str) -> bool:
    """Whether a file bears no final name, or lies in a folder that bears none."""
    return any(".part" in part for part in Path(name).parts)


def _writes(out: Path) -> int:
    """When something in the result was changed last, ns."""
    places = (out, out / "work", out / "maps", out / "asset")
    return max((place.stat().st_mtime_ns for place in places if place.exists()), default=0)


def spent_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime; proc(5)


def undisturbed(step: Step, out: Path) -> tuple[float, float]:
    """Processor time at which the command first writes, and ends, s."""
    before, first, last = _writes(out), None, 0.0
    run = start("polcap", *step, out)
    while run.poll() is None:
        last = spent_s(run.pid)
        if first is None and _writes(out) != before:
            first = last
        time.sleep(_POLL_S)
    assert run.returncode in (0, 3), (step, run.returncode)
    return first or 0.0, last


def kill_amid(step: Step, out: Path, moment_s: float) -> bool:
    """Start the command and kill it once it took so much processor time; False if it ended before."""
    run = start("polcap", *step, out)
    while run.poll() is None and spent_s(run.pid) < moment_s:
        time.sleep(_POLL_S)
    amid = run.poll() is None
    run.kill()
    run.wait()
    return amid


def broken_names(folder: Path, *whole: dict[str, str]) -> list[str]:
    """Files under a final name that differ from every undisturbed result; missing files are not broken."""
    found = digests(folder) if folder.exists() else {}
    final = {name: digest for name, digest in found.items() if not _partial(name)}
    strange = [name for name, digest in final.items() if all(one.get(name) != digest for one in whole)]
    return sorted(name for name in strange if not name.endswith(".json") or _content(folder / name) is None)


def main(kills: int, seed: int, rows: Rows) -> int:
    """Failures."""
    with tempfile.TemporaryDirectory() as place:
        capture = Path(place) / "capture"
        small_capture(capture)
        photographs = digests(capture)
        whole = Path(place) / "whole"
        steps: tuple[Step, ...] = (
            ("process", capture, "--estimator", "analytic", "--no-chart", "--out"),
            ("export", "--gltf", "--obj", "--usd", "--materialx", "--exr"),
        )
        spans = [undisturbed(steps[0], whole)]
        stages = [digests(whole)]
        spans.append(undisturbed(steps[1], whole))
        stages.append(digests(whole))
        spans_text = ", ".join(f"{step[0]} {span[1]:.1f} s" for step, span in zip(steps, spans))
        print(f"undisturbed: {spans_text}, {len(stages[-1])} files", flush=True)
        done = rows.done("seed", "number")
        for number in range(-(-kills // len(steps))):
            if (seed, number) in done:
                continue
            random = np.random.default_rng([seed, number])
            out, before = Path(place) / "killed", processor_s()
            row: dict[str, object] = {"seed": seed, "number": number}
            for step, (first, last), wanted in zip(steps, spans, stages):
                amid = kill_amid(step, out, random.uniform(first if number % 2 else 0.0, last))
                broken = broken_names(out, *stages)
                code = start("polcap", *step, out).wait()
                found = digests(out)
                differ = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
                row[str(step[0])] = {"amid": amid, "broken": broken, "code": code, "differ": differ}
            row["photographs"] = digests(capture) == photographs
            row["processor"] = round(processor_s() - before, 1)
            rows.add(row)
            print(json.dumps(row), flush=True)
            shutil.rmtree(out)
    return summary(rows)


def summary(rows: Rows) -> int:
    """Failures of all rounds so far."""
    halves = [row[step] for row in rows.all for step in ("process", "export")]
    failures = sum(bool(half["broken"] or half["differ"] or half["code"] not in (0, 3)) for half in halves)
    failures += sum(not row["photographs"] for row in rows.all)
    spent = sum(row["processor"] for row in rows.all)
    print(f"{len(halves)} kills, {sum(half['amid'] for half in halves)} amid a run; {failures} failures; {spent:.0f} s")
    return failures


if __name__ == "__main__":
    stated = arguments(__doc__, kills=30, seed=0, rows=Rows())
    sys.exit(1 if main(stated.kills, stated.seed, stated.rows) else 0)
