"""Small captures one after the other in one process: memory and open memory maps after each.

python tests/campaigns/soak.py [--captures 100]

A capture of 320 × 240 px, analytic estimator, each run into a new folder. Prints the slope of resident memory after the
twentieth run, MB a capture, and the memory maps of results that are open at the beginning and at the end.
"""

import argparse
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap.config import Config
from polcap.errors import GateError
from polcap.formats.capture import reader as captures
from polcap.images import ChartRequest
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput
from tests.campaigns import small_capture

_SETTLED = 20  # captures after which memory should not grow


def resident_mb() -> float:
    """Private memory of this process; mapped files, which the system takes back at will, apart."""
    told = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(told["RssAnon"].split()[0]) / 1024


def open_maps(folder: str) -> int:
    """Files of results that are mapped now."""
    return sum(folder in line for line in Path("/proc/self/maps").read_text().splitlines())


def main(count: int) -> None:
    """Print the table."""
    memory, maps = [], []
    with tempfile.TemporaryDirectory() as place:
        capture = Path(place) / "capture"
        small_capture.write(capture)
        for number in range(count):
            out = Path(place) / f"{number:03d}"
            with suppress(GateError):
                pipeline.process(captures.read(capture), UserInput(chart=ChartRequest("none")), Config(), out)
            shutil.rmtree(out)
            memory.append(resident_mb())
            maps.append(open_maps(place))
            print(f"{number:4d} {memory[-1]:8.1f} MB {maps[-1]:4d} maps", flush=True)
    settled = memory[min(_SETTLED, count // 3) :]
    slope = np.polyfit(np.arange(len(settled)), settled, 1)[0]
    told = f"{slope:+.3f} MB per capture after the {min(_SETTLED, count // 3)}th"
    print(f"{count} captures: {told}; maps {maps[0]} at first, {maps[-1]} last")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--captures", type=int, default=100)
    main(arguments.parse_args().captures)
