"""Random valid captures with almost no content, through the whole path.

python -m tests.campaigns.odd_captures [--captures 60] [--seed 0]

Frames are all clipped, all dark, flat, a single bright pixel, noise, a ramp, half clipped, or a mixture by shot; sizes
are tiny; masks are absent, one pixel, all of the frame or random. Every run must end with 0, 2 or 3 within its limit,
and all written values must be finite. Prints the outcomes; exit code 1 after a failure.
"""

import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import GateError, InputError
from polcap.formats.capture import reader as captures
from polcap.formats.maps import maps_folder as maps
from polcap.image_values import Floats
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput
from tests.experiments import arguments, table
from tests.formats import headers

BLACK, WHITE = 512, 16383
LIMIT_S = 30.0  # of processor time
Random = np.random.Generator
CONTENT: dict[str, Callable[[Floats, Random], Floats]] = {  # from a noise of deviation 1, (H, W), to counts
    "clipped": lambda noise, random: np.full_like(noise, WHITE),
    "dark": lambda noise, random: BLACK + 3 * noise,
    "zero": lambda noise, random: np.full_like(noise, BLACK),
    "flat": lambda noise, random: np.full_like(noise, 4000),
    "noise": lambda noise, random: 4000 + 300 * noise,
    "one pixel": lambda noise, random: np.where(
        np.arange(noise.size).reshape(noise.shape) == 999, WHITE, BLACK + 3 * noise
    ),
    "ramp": lambda noise, random: np.linspace(BLACK, WHITE, noise.size).reshape(noise.shape),
    "half clipped": lambda noise, random: np.where(np.arange(noise.shape[1]) % 40 < 20, WHITE, 4000 + 200 * noise),
    "disc": lambda noise, random: _disc(noise),
}


def _disc(noise: Floats) -> Floats:
    y, x = np.mgrid[-1 : 1 : noise.shape[0] * 1j, -1 : 1 : noise.shape[1] * 1j]
    return np.where(x * x + y * y < 0.3, 6000 + 80 * noise, BLACK + 100 + 8 * noise)


def write(folder: Path, contents: list[str], size: tuple[int, int], exposures: int, random: Random) -> None:
    """Write a capture at 0, 45 and 90 degrees; `contents` names the content of each shot."""
    taken = 0
    for angle, name in zip((0, 45, 90), contents):
        place = folder / f"pol{angle:03d}"
        place.mkdir(parents=True)
        for e in range(exposures):
            counts = BLACK + (CONTENT[name](random.normal(size=size), random) - BLACK) * 4.0**e
            pixels = np.clip(counts, 0, WHITE).round()
            pixels[0, 0] = taken = taken + 1  # no two files are the same
            photo = headers.settings(time=4.0**e / 200)
            black = [[BLACK, BLACK], [BLACK, BLACK]]
            (place / f"IMG_{e}.dng").write_bytes(headers.dng(pixels, photo=photo, black=black))


def mask(kind: str, size: tuple[int, int], random: Random) -> np.ndarray | None:
    middle = np.zeros(size, bool)
    middle[size[0] // 2, size[1] // 2] = True
    return {"none": None, "all": np.ones(size, bool), "one pixel": middle, "random": random.random(size) < 0.5}[kind]


def run(folder: Path, drawn: np.ndarray | None) -> str:
    """The outcome of a run in a word; written maps are checked."""
    out = folder / "polcap"
    try:
        found = captures.read(folder)
        about = pipeline.process(found, UserInput(ChartRequest("none"), drawn), Config(), out)
    except GateError:
        return "gate"
    except InputError as error:
        assert "\n" not in str(error), error
        return type(error).__name__
    stored = maps.read(out / "maps")  # refuses values that are not finite
    assert about is not None and stored.mask.any()
    return f"verdict {about['verdict']}"


def main(count: int, seed: int) -> int:
    """Run so many captures; returns the number of failures."""
    random = np.random.default_rng(seed)
    outcomes: Counter[str] = Counter()
    failures, slowest = 0, 0.0
    for _ in range(count):
        alike = random.random() < 0.6
        contents = [str(name) for name in random.choice(list(CONTENT), 1 if alike else 3)] * (3 if alike else 1)
        size = (2 * int(random.integers(40, 100)), 2 * int(random.integers(40, 100)))
        kind = str(random.choice(["none", "none", "one pixel", "all", "random"]))
        start = time.process_time()  # independent of the load of the machine
        with tempfile.TemporaryDirectory() as place:
            try:
                write(Path(place) / "c", contents, size, int(random.integers(1, 4)), random)
                outcomes[run(Path(place) / "c", mask(kind, size, random))] += 1
            except Exception:
                failures += 1
                print(f"{contents}, {size}, mask {kind}:\n{traceback.format_exc()}")
        spent = time.process_time() - start
        slowest = max(slowest, spent)
        failures += spent > LIMIT_S
    print(table(list(outcomes.most_common()), ("outcome", "captures")))
    print(f"{count} captures, slowest {slowest:.1f} s, {failures} failures")
    return failures


if __name__ == "__main__":
    stated = arguments(__doc__, captures=60, seed=0)
    sys.exit(1 if main(stated.captures, stated.seed) else 0)
