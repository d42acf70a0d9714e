"""kill -9 at random moments over `polcap process` and `export`; then the same command again, undisturbed.

python tests/campaigns/kill.py [--kills 30] [--seed 0]

Each of the kills is one of `process` and one of `export`, on a capture of 320 × 240 px.

After each resume every file of the result has the bytes of a run that nobody disturbed (times of measurement apart),
no partial file lies under a final name, none is left over, and the photographs are what they were.
"""

import argparse
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

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.campaigns import small_capture  # noqa: E402

_CLOCK = {"seconds", "timings", "time"}  # keys of JSON that hold measured times


def polcap(*arguments: object) -> subprocess.Popen[bytes]:
    """The command, in a process of its own."""
    command = [sys.executable, "-m", "polcap", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def digests(folder: Path) -> dict[str, str]:
    """Of every file; JSON without the measured times, the page that shows them left out."""
    found = {}
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = str(file.relative_to(folder))
        if name in ("work/lock", "work/owner", "work/written.json", "work/unchanged.json", "report.html"):
            continue
        data = file.read_bytes()
        if file.suffix == ".json":
            data = json.dumps(_timeless(json.loads(data)), sort_keys=True).encode()
        found[name] = blake2b(data, digest_size=16).hexdigest()
    return found


def _timeless(value: object) -> object:
    if isinstance(value, dict):
        return {name: _timeless(item) for name, item in value.items() if name not in _CLOCK}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def main(kills: int, seed: int) -> int:
    """Failures."""
    random = np.random.default_rng(seed)
    failures = killed = 0
    with tempfile.TemporaryDirectory() as place:
        capture = Path(place) / "capture"
        small_capture.write(capture)
        photographs = digests(capture)
        whole = Path(place) / "whole"
        steps: tuple[tuple[str | Path, ...], ...] = (
            ("process", capture, "--estimator", "analytic", "--no-chart", "--out"),
            ("export",),
        )
        spans = []
        for step in steps:
            start = time.perf_counter()
            code = polcap(*step, whole).wait()
            spans.append(time.perf_counter() - start)
            assert code in (0, 3), code
        wanted = digests(whole)
        print(f"undisturbed: process {spans[0]:.1f} s, export {spans[1]:.1f} s, {len(wanted)} files", flush=True)
        for number in range(kills):
            out = Path(place) / "killed"
            for step, span in zip(steps, spans):
                run = polcap(*step, out)
                time.sleep(float(random.uniform(0, span)))
                killed += run.poll() is None
                run.kill()
                run.wait()
                polcap(*step, out).wait()
            found = digests(out)
            wrong = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
            failures += bool(wrong) or digests(capture) != photographs
            print(f"{number:4d} {wrong or 'same bytes'}", flush=True)
            shutil.rmtree(out)
    print(f"{killed} kills amid a run, {failures} failures")
    return failures


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--kills", type=int, default=30)
    arguments.add_argument("--seed", type=int, default=0)
    given = arguments.parse_args()
    sys.exit(1 if main(given.kills, given.seed) else 0)
