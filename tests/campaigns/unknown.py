"""Error of polarizer angles that nobody noted, and whether unfound angles are refused.

python -m tests.campaigns.unknown [--objects 40] [--shots 5] [--first-seed 0] [--rows FILE]

Objects of `lit_objects` shot at random angles (that determine the Stokes parameters), gains known to 0.1 %, as with a
chart.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from polcap.errors import CaptureError
from polcap.image_values import Floats
from polcap.optics import mueller
from polcap.stage_values import Equipment
from polcap.stages import selfcal
from tests import scenes
from tests.campaigns import lit_objects
from tests.experiments import Rows, arguments, processor_s

_GAIN_ERROR = 0.001
_MOST_CONDITION = 6.0  # of the analyzers; 0°, 45°, 90° have 3.2


def main() -> None:
    stated = arguments(__doc__, objects=40, shots=5, first_seed=0, rows=Rows())
    rows, done = stated.rows, stated.rows.done("seed", "shots")
    for seed in range(stated.first_seed, stated.first_seed + stated.objects):
        if (seed, stated.shots) not in done:
            rows.add({"seed": seed, "shots": stated.shots, **one(seed, stated.shots)})
            print(rows.all[-1], flush=True)
    some = [row for row in rows.all if row["shots"] == stated.shots]
    found = [row for row in some if "error" in row]
    print(f"{len(some)} cases: {len(some) - len(found)} refused, {len(found)} found")
    if found:
        error, sigma = (np.array([row[key] for row in found]) for key in ("error", "sigma"))
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
    """A row: error of the worst angle and the stated 1σ, degrees; or the reason of the refusal."""
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
    off = (found.angle - true + np.pi / 2) % np.pi - np.pi / 2
    return {"error": float(np.degrees(np.abs(off)).max()), "sigma": float(np.degrees(found.found_sigma))}


if __name__ == "__main__":
    main()
