"""Whether shots in a wrong order, or counted the wrong way, are seen, and those in order kept.

python -m tests.campaigns.order [--objects 20] [--first-seed 0] [--angles 0,45,90] [--thin] [--chart] [--raw]

Objects of `lit_objects` under a flash that repeats within 2 %, each in order and in every order that gives analyzers of
its own. An order is refused, doubted (the gate `order` warns) or passes. With --chart gains are known, as grey patches
tell them; with --raw photographs are shot and read, brackets, nudges and chart included, and the mask is polcap's.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from polcap.config import Config
from polcap.errors import CaptureError, InputError
from polcap.formats.capture import reader as captures
from polcap.images import Alignment, AngleStack, ColorCalibration, Equipment, Floats, ObjectMask
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.stages import selfcal
from polcap.stages.selfcal import angles as polarizer_angles
from polcap.synth import scenes as random_scenes
from polcap.synth import shooting
from tests import scenes
from tests.campaigns import lit_objects
from tests.campaigns.ring import KINDS
from tests.campaigns.rows import processor_s

Before = tuple[str, AngleStack, Alignment, ObjectMask, ColorCalibration]  # what `selfcal` is given, and its name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--angles", default="0,45,90")
    parser.add_argument("--thin", action="store_true")
    parser.add_argument("--chart", action="store_true")
    parser.add_argument("--raw", action="store_true")
    given = parser.parse_args()
    angle = np.radians([float(one) for one in given.angles.split(",")])
    right, wrong = Counter[str](), Counter[str]()
    for seed in range(given.first_seed, given.first_seed + given.objects):
        case = from_raw(seed, given.angles) if given.raw else at_stokes_level(seed, angle, given.thin, given.chart)
        for name, radiance, alignment, object_, color in case:
            seen = []
            for number, stated in enumerate(polarizer_angles.hypotheses(angle).values()):
                said = judged(radiance, alignment, object_, color, stated)
                (wrong if number else right)[said] += 1
                seen.append(said)
            print(seed, name, "right:", seen[0], "wrong:", ", ".join(seen[1:]), flush=True)
    print("in order:", dict(right), "\nout of order:", dict(wrong))
    print(f"{processor_s():.0f} s of processor time")


def at_stokes_level(seed: int, angle: Floats, thin: bool, chart: bool) -> Iterator[Before]:
    """The seed's object without its photographs."""
    case = lit_objects.lit(seed, thin)
    gain = 1 + (0 if chart else 0.02) * np.random.default_rng([seed, 13]).normal(size=len(angle))
    radiance = replace(lit_objects.stack(case, angle, seed, gain), equipment=Equipment("steady" if chart else "flash"))
    yield case.look, radiance, scenes.still(len(angle)), lit_objects.object_of(case), scenes.no_color()


def from_raw(seed: int, angles: str) -> Iterator[Before]:
    """The seed's object shot, read, merged and found; nothing where that is refused."""
    degrees = tuple(float(one) for one in angles.split(","))
    shoot = shooting.Shoot(seed=seed, width=640, height=480, samples=1, angles_deg=degrees)
    with tempfile.TemporaryDirectory() as place:
        shooting.write(Path(place) / "capture", random_scenes.random_scene(seed, KINDS[seed % 3]), shoot)
        supplied = UserInput(mask_network=models.load_mask_network(1))
        capture = captures.read(Path(place) / "capture")
        try:
            results = path(capture, supplied, Config(), MemoryCache(until="mask"))
            parts = results.radiance, results.alignment, results.object_, results.color
        except InputError as error:
            print(seed, "refused before:", error, flush=True)
            return
        yield KINDS[seed % 3], *parts


def judged(
    radiance: AngleStack, alignment: Alignment, object_: ObjectMask, color: ColorCalibration, stated: Floats
) -> str:
    """What becomes of a capture whose shots are said to have been taken at angles (K,) rad."""
    try:
        found = selfcal.solve(replace(radiance, angle=stated), alignment, object_, color, selfcal.SelfcalSettings())
    except CaptureError:
        return "refused"
    return "doubted" if found.outline.rival else "passes"


if __name__ == "__main__":
    main()
