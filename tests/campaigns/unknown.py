"""How well angles that nobody noted are found, and whether what is not found is refused.

python -m tests.campaigns.unknown [--objects 40] [--shots 5] [--first-seed 0] [--rows FILE]

Objects of `lit_objects` shot at angles drawn at random (such as determine the Stokes parameters), gains known to 0.1 %,
as of a chart. With --rows it goes on where it stopped.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polcap.errors import CaptureError
from polcap.images import Equipment, Floats
from polcap.optics import mueller
from polcap.stages import selfcal
from tests import scenes
from tests.campaigns import lit_objects
from tests.campaigns.rows import Rows, processor_s

_GAIN_ERROR = 0.001
_MOST_CONDITION = 6.0  # of the analyzers; 0°, 45°, 90° have 3.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--shots", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rows", type=Path)
    given = parser.parse_args()
    rows = Rows(given.rows)
    done = rows.done("seed", "shots")
    for seed in range(given.first_seed, given.first_seed + given.objects):
        if (seed, given.shots) not in done:
            rows.add({"seed": seed, "shots": given.shots, **one(seed, given.shots)})
            print(rows.all[-1], flush=True)
    some = [row for row in rows.all if row["shots"] == given.shots]
    told = [row for row in some if "error" in row]
    print(f"{len(some)} cases: {len(some) - len(told)} refused, {len(told)} found")
    if told:
        error, sigma = (np.array([row[key] for row in told]) for key in ("error", "sigma"))
        print(f"worst angle of a case: median {np.median(error):.2f}°, 90 % {np.quantile(error, 0.9):.2f}°", end=", ")
        print(f"most {error.max():.2f}°; beyond 2σ {(error > 2 * sigma).sum()}, beyond 3σ {(error > 3 * sigma).sum()}")
    print(f"{processor_s():.0f} s of processor time")


def drawn(seed: int, shots: int) -> Floats:
    """Angles (K,) rad."""
    random = np.random.default_rng([seed, 19, shots])
    while True:
        angle = random.uniform(0, np.pi, shots)
        if np.linalg.cond(mueller.analyzer(angle)) < _MOST_CONDITION:
            return angle


def one(seed: int, shots: int) -> dict[str, Any]:
    """A row: error of the worst angle and the 1σ that is stated, degrees; or why it was refused."""
    case, true = lit_objects.lit(seed), drawn(seed, shots)
    gain = 1 + _GAIN_ERROR * np.random.default_rng([seed, 20]).normal(size=shots)
    names = np.radians(np.arange(shots))
    radiance = replace(lit_objects.stack(case, true, seed, gain, names), equipment=Equipment("one exposure"))
    settings = selfcal.SelfcalSettings(unknown_angles=True)
    try:
        found = selfcal.solve(radiance, scenes.still(shots), lit_objects.object_of(case), scenes.no_color(), settings)
    except CaptureError as error:
        return {"refused": str(error)[:60]}
    assert found.found_sigma is not None
    apart = (found.angle - true + np.pi / 2) % np.pi - np.pi / 2
    return {"error": float(np.degrees(np.abs(apart)).max()), "sigma": float(np.degrees(found.found_sigma))}


if __name__ == "__main__":
    main()
