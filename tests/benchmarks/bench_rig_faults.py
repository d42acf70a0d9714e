"""Test of the rig: a hundred simulated captures with one random device fault each, then resumed.

python tests/benchmarks/bench_rig_faults.py [COUNT]

The rotators are simulated at the protocol level, by a clock of their own; the camera hands out photographs made
beforehand and sees the ring's true angle. Each trial checks: an end in time, every delivered frame on disk, every
frame in capture.toml whole, no angle off by more than 0.06°, `--resume` takes exactly what is missing, and every frame
of the finished capture equals the undisturbed one's. One capture per class is then processed, and so is the undisturbed
one.
"""

import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import PolcapError
from polcap.formats.capture import reader as captures
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput
from polcap.results import Results
from tests.rig import faults
from tests.rig import pool as pools


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 6 * len(faults.CLASSES)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    pool = pools.photographs(width=256, height=192)
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        expected = {}
        for kind in faults.KINDS:
            faults.undisturbed(kind, pool, root / kind.__name__)
            expected[kind.__name__] = _processed(root / kind.__name__)
        print("| class | seed | rotator | ended | kept | then taken | s | asset |\n|---|---|---|---|---|---|---|---|")
        outcomes, broken, alike = [], 0, 0
        for number in range(count):
            fault, seed = faults.CLASSES[number % len(faults.CLASSES)], number // len(faults.CLASSES)
            folder = root / f"{fault}-{seed}"
            try:
                outcome = faults.trial(fault, seed, pool, folder)
            except (AssertionError, PolcapError) as error:
                broken += 1
                print(f"| {fault} | {seed} | | BROKEN: {error} | | | | |", flush=True)
                continue
            outcomes.append(outcome)
            asset = ""
            if seed == 0:
                pairs = zip(expected[outcome.rotator], _processed(folder), strict=True)
                same = all(np.array_equal(a, b) for a, b in pairs)
                asset, alike = ("same", alike + 1) if same else ("DIFFERS", alike)
                broken += not same
            cells = (*outcome[:-1], f"{outcome.seconds:.1f}", asset)
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
        ends = Counter(outcome.ending for outcome in outcomes).most_common()
        slowest = max(outcomes, key=lambda outcome: outcome.seconds)
        print(
            f"\n{count} faults of {len(faults.CLASSES)} classes, {broken} promises broken; {alike} processed to the "
            f"undisturbed asset; slowest end {slowest.seconds:.1f} s ({slowest.fault}); "
            f"ended: {', '.join(f'{end} {times} times' for end, times in ends)}"
        )
    raise SystemExit(broken > 0)


def _processed(folder: Path) -> list[np.ndarray]:
    """Normals, albedo and vertices of the analytic estimator."""
    found = captures.read(folder)
    out = folder / "polcap"
    pipeline.process(found, UserInput(chart=ChartRequest("none")), Config(), out)
    results, _ = pipeline.reopen(out, Results)
    maps, mesh = results.maps, results.mesh
    return [np.asarray(maps.normal), np.asarray(maps.diffuse), np.asarray(mesh.vertices)]


if __name__ == "__main__":
    main()
