"""Small captures one after the other in one process: memory and open memory maps after each.

python -m tests.campaigns.soak [--captures 100]

A capture of 320 × 240 px, analytic estimator, each run into a new folder. Prints the slope of resident memory after the
twentieth run, MB a capture, and the number of mapped result files at the beginning and at the end.
"""

import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import GateError
from polcap.formats.capture import reader as captures
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput
from tests.experiments import arguments, small_capture

_SETTLED = 20  # captures after which memory should not grow


def resident_mb() -> float:
    """Private memory of this process, without mapped files, which the system takes back at will."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["RssAnon"].split()[0]) / 1024


def main(count: int) -> None:
    """Print the table."""
    memory, maps = [], []
    with tempfile.TemporaryDirectory() as place:
        capture = Path(place) / "capture"
        small_capture(capture)
        for number in range(count):
            out = Path(place) / f"{number:03d}"
            with suppress(GateError):
                pipeline.process(captures.read(capture), UserInput(chart=ChartRequest("none")), Config(), out)
            shutil.rmtree(out)
            memory.append(resident_mb())
            maps.append(sum(place in line for line in Path("/proc/self/maps").read_text().splitlines()))
            print(f"{number:4d} {memory[-1]:8.1f} MB {maps[-1]:4d} maps", flush=True)
    first = min(_SETTLED, count // 3)
    slope = np.polyfit(np.arange(count - first), memory[first:], 1)[0]
    growth = f"{slope:+.3f} MB per capture after the {first}th"
    print(f"{count} captures: {growth}; maps {maps[0]} at first, {maps[-1]} last")


if __name__ == "__main__":
    main(arguments(__doc__, captures=100).captures)
