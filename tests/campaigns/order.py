"""Whether shots in a wrong order or sense are refused, and shots in the right order accepted.

python -m tests.campaigns.order [--objects 20] [--first-seed 0] [--angles 0,45,90] [--thin] [--chart] [--raw]

Objects of `lit_objects` under a flash that repeats within 2 %, each in the right order and in every order with other
analyzers. An order is refused, doubted (the gate `order` warns) or passes. With --chart gains are known, as from grey
patches; with --raw photographs are shot and read, with brackets, nudges, chart and polcap's own mask.
"""

import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.errors import CaptureError, InputError
from polcap.formats.capture import reader as captures
from polcap.image_values import Floats
from polcap.pipeline import models
from polcap.results import ResultsUntilMask
from polcap.stage_values import Alignment, AngleStack, Equipment, ObjectMask
from polcap.stages import selfcal
from polcap.stages.selfcal import angles as polarizer_angles
from polcap.synth import scenes as random_scenes
from polcap.synth import shooting
from tests import scenes
from tests.campaigns import lit_objects
from tests.campaigns.ring import KINDS
from tests.experiments import arguments, process, processor_s

Case = tuple[str, AngleStack, Alignment, ObjectMask, ColorCalibration]  # name and inputs of `selfcal`


def main() -> None:
    stated = arguments(__doc__, "--thin", "--chart", "--raw", objects=20, first_seed=0, angles="0,45,90")
    degrees = tuple(float(one) for one in stated.angles.split(","))
    angle = np.radians(degrees)
    right, wrong = Counter[str](), Counter[str]()
    for seed in range(stated.first_seed, stated.first_seed + stated.objects):
        case = from_raw(seed, degrees) if stated.raw else at_stokes_level(seed, angle, stated.thin, stated.chart)
        if case is not None:
            seen = [judged(case, stated_angle) for stated_angle in polarizer_angles.hypotheses(angle).values()]
            right[seen[0]] += 1
            wrong.update(seen[1:])
            print(seed, case[0], "right:", seen[0], "wrong:", ", ".join(seen[1:]), flush=True)
    print("in order:", dict(right), "\nout of order:", dict(wrong))
    print(f"{processor_s():.0f} s of processor time")


def at_stokes_level(seed: int, angle: Floats, thin: bool, chart: bool) -> Case | None:
    """The seed's object without its photographs."""
    case = lit_objects.lit(seed, thin)
    gain = 1 + (0 if chart else 0.02) * np.random.default_rng([seed, 13]).normal(size=len(angle))
    radiance = replace(lit_objects.stack(case, angle, seed, gain), equipment=Equipment("steady" if chart else "flash"))
    return case.finish, radiance, scenes.still(len(angle)), lit_objects.object_of(case), scenes.no_color()


def from_raw(seed: int, degrees: tuple[float, ...]) -> Case | None:
    """The seed's object shot, read, merged and found; None where polcap refuses it."""
    shoot = shooting.Shoot(seed=seed, width=640, height=480, samples=1, angles_deg=degrees)
    with tempfile.TemporaryDirectory() as place:
        shooting.write(Path(place) / "capture", random_scenes.random_scene(seed, KINDS[seed % 3]), shoot)
        capture = captures.read(Path(place) / "capture")
        try:
            results = process(capture, ResultsUntilMask, (None, models.load_mask_network(1)))
            return KINDS[seed % 3], results.radiance, results.alignment, results.object_, results.color
        except InputError as error:
            print(seed, "refused before:", error, flush=True)
            return None


def judged(case: Case, stated: Floats) -> str:
    """Outcome of a capture with stated angles (K,) rad."""
    _, radiance, alignment, object_, color = case
    try:
        found = selfcal.solve(replace(radiance, angle=stated), alignment, object_, color, selfcal.SelfcalSettings())
    except CaptureError:
        return "refused"
    return "doubted" if found.outline.rival else "passes"


if __name__ == "__main__":
    main()
