"""Whether shots in a wrong order, or counted the wrong way, are seen, and those in order kept.

python -m tests.campaigns.order [--objects 20] [--first-seed 0] [--angles 0,45,90] [--thin] [--chart]

Objects of `lit_objects` under a flash that repeats within 2 %, each in order and in every order that gives analyzers of
its own. An order is refused, doubted (the gate `order` warns) or passes. With --chart gains are known, as grey patches
tell them.
"""

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from polcap.errors import CaptureError
from polcap.images import AngleStack
from polcap.stages import selfcal
from polcap.stages.selfcal import order
from tests import scenes
from tests.campaigns import lit_objects


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--angles", default="0,45,90")
    parser.add_argument("--thin", action="store_true")
    parser.add_argument("--chart", action="store_true")
    given = parser.parse_args()
    angle = np.radians([float(one) for one in given.angles.split(",")])
    right, wrong = Counter[str](), Counter[str]()
    for seed in range(given.first_seed, given.first_seed + given.objects):
        case = lit_objects.lit(seed, given.thin)
        gain = 1 + (0 if given.chart else 0.02) * np.random.default_rng([seed, 13]).normal(size=len(angle))
        radiance = lit_objects.stack(case, angle, seed, gain)
        radiance = replace(radiance, light="steady" if given.chart else "flash")
        seen = []
        for number, stated in enumerate(order.hypotheses(angle).values()):
            said = judged(case, replace(radiance, angle=stated))
            (wrong if number else right)[said] += 1
            seen.append(said)
        print(seed, case.look, "right:", seen[0], "wrong:", ", ".join(seen[1:]), flush=True)
    print("in order:", dict(right), "\nout of order:", dict(wrong))


def judged(case: lit_objects.Lit, radiance: AngleStack) -> str:
    """What becomes of a capture."""
    shots = len(radiance.angle)
    try:
        found = selfcal.solve(
            radiance, scenes.still(shots), lit_objects.object_of(case), scenes.no_color(), selfcal.Settings()
        )
    except CaptureError:
        return "refused"
    return "doubted" if found.rival else "passes"


if __name__ == "__main__":
    main()
