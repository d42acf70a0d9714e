"""How well a mis-set ring is found, and that what does not tell it is left alone.

python -m tests.campaigns.ring [--objects 50] [--turns 4] [--first-seed 0] [--no-chart] [--raw] [--rows FILE]

Objects of `lit_objects` (closed shapes and, every third, clusters of thin parts that hide one another) under a flash
whose gains a chart tells to 0.1 %, with --no-chart one that repeats within 1 %; each with so many turns of the ring,
drawn from ±10°, one of them 0. With --raw whole captures are shot and read, brackets, nudges and chart included. A turn
is applied where it is sure; of what is applied all should be right within 0.2°. With --rows it goes on where it
stopped.
"""

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.images import RingZero
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.stages import selfcal
from polcap.synth import scenes as random_scenes
from polcap.synth import shooting
from tests import scenes
from tests.campaigns import lit_objects
from tests.campaigns.rows import Rows, processor_s

_ANGLE = np.radians([0.0, 45.0, 90.0])
_GAIN_ERROR = 0.001  # 1σ of a gain that a chart tells
_FLASH = 0.01  # 1σ of a pop
_MOST_TURN = 10.0  # degrees
GOOD_DEG = 0.2
KINDS: tuple[Literal["bumps", "clusters", "vase"], ...] = ("bumps", "clusters", "vase")  # clusters are thin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=50)
    parser.add_argument("--turns", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--no-chart", action="store_true")
    parser.add_argument("--raw", action="store_true")
    parser.add_argument("--rows", type=Path)
    given = parser.parse_args()
    rows = Rows(given.rows)
    done = rows.done("seed", "turn_number", "raw")
    for seed in range(given.first_seed, given.first_seed + given.objects):
        wanted = [t for t in range(given.turns) if (seed, t, given.raw) not in done]
        case = lit_objects.lit(seed) if wanted and not given.raw else None
        for number in wanted:
            turn = planted(seed, number)
            chart = not given.no_chart
            found = from_raw(seed, turn) if case is None else at_stokes_level(case, seed, number, turn, chart)
            rows.add({"seed": seed, "turn_number": number, "raw": given.raw, "planted": turn, **found})
            print(rows.all[-1], flush=True)
    print(summary([row for row in rows.all if row["raw"] == given.raw]))
    print(f"{processor_s():.0f} s of processor time")


def planted(seed: int, number: int) -> float:
    """True less stated angle of the ring, degrees; the first of every object is 0."""
    return (
        round(float(np.random.default_rng([seed, 17, number]).uniform(-_MOST_TURN, _MOST_TURN)), 1) if number else 0.0
    )


def at_stokes_level(case: lit_objects.Lit, seed: int, number: int, turn: float, chart: bool) -> dict[str, Any]:
    """What selfcal says of an object's shots."""
    repeats = _GAIN_ERROR if chart else _FLASH
    gain = 1 + repeats * np.random.default_rng([seed, 18, number]).normal(size=len(_ANGLE))
    radiance = lit_objects.stack(case, _ANGLE + np.radians(turn), seed, gain, _ANGLE)
    if chart:
        spread = _GAIN_ERROR / 2**0.5  # as well as a chart would tell
        radiance = replace(radiance, equipment=replace(radiance.equipment, flash_spread=spread))
    found = selfcal.solve(
        radiance,
        scenes.still(len(_ANGLE)),
        lit_objects.object_of(case),
        scenes.no_color(),
        selfcal.SelfcalSettings(check_order=False),
    )
    return error_of(found.ring, KINDS[seed // 2 % 3])


def from_raw(seed: int, turn: float) -> dict[str, Any]:
    """The same of photographs that are shot, read and merged, with a chart, the mask found by polcap."""
    kind = KINDS[seed % 3]
    true = [(angle + turn) % 180 for angle in np.degrees(_ANGLE)]
    shoot = shooting.Shoot(
        seed=seed, width=640, height=480, samples=1, angles_deg=tuple(round(float(a), 1) for a in true)
    )
    with tempfile.TemporaryDirectory() as place:
        shooting.write(Path(place) / "capture", random_scenes.random_scene(seed, kind), shoot)
        capture = captures.read(Path(place) / "capture")
        nominal = [min(_ANGLE, key=lambda a: _apart(shot.angle - math.radians(turn), a)) for shot in capture.shots]
        shots = tuple(replace(shot, angle=float(a)) for shot, a in zip(capture.shots, nominal))
        supplied = UserInput(mask_network=models.load_mask_network(1))
        try:
            results = path(replace(capture, shots=shots), supplied, Config(), MemoryCache(until="selfcal"))
            return error_of(results.selfcal.ring, kind)
        except InputError as error:
            return {"kind": kind, "refused": str(error)}


def _apart(a: float, b: float) -> float:
    """Between two axes, rad."""
    return abs((a - b + math.pi / 2) % math.pi - math.pi / 2)


def error_of(found: RingZero, kind: str) -> dict[str, Any]:
    """A row: what was found of the ring, and what was done about it, degrees."""
    turn, sigma, applied = np.degrees([found.offset, found.sigma, found.correction])
    return {"kind": kind, "turn": float(turn), "sigma": float(sigma), "applied": float(applied)}


def summary(rows: list[dict[str, Any]]) -> str:
    """The distribution of what was found, closed and thin objects apart."""
    lines = []
    for name, kinds in (("closed", ("bumps", "vase")), ("thin", ("clusters",))):
        some = [row for row in rows if row["kind"] in kinds and "refused" not in row]
        refused = sum(row["kind"] in kinds and "refused" in row for row in rows)
        if not some:
            continue
        planted_, turn, sigma, applied = (
            np.array([row[key] for row in some]) for key in ("planted", "turn", "sigma", "applied")
        )
        error, used = np.abs(turn - planted_), applied != 0
        lines.append(
            f"{name}: {len(some)} cases, {refused} refused; error median {np.median(error):.2f}°, "
            f"90 % {np.quantile(error, 0.9):.2f}°; 1σ median {np.median(sigma):.2f}°; "
            f"beyond 3σ {(error > 3 * sigma).sum()}, beyond 2σ {(error > 2 * sigma).sum()}"
        )
        off = np.abs(applied - planted_)
        lines.append(
            f"  applied {used.sum()}"
            + (
                f": within {GOOD_DEG}° {(off[used] <= GOOD_DEG).sum()}, median {np.median(off[used]):.2f}°, "
                f"90 % {np.quantile(off[used], 0.9):.2f}°, most {off[used].max():.2f}°, "
                f"none of them worse than as stated: {bool((off[used] <= np.abs(planted_[used])).all())}"
                if used.any()
                else ""
            )
        )
        far = ~used & (np.abs(planted_) > 1)
        lines.append(f"  left alone though off by more than 1°: {far.sum()}, their 1σ at least {least(sigma[far])}")
    return "\n".join(lines)


def least(sigma: np.ndarray) -> str:
    """In words."""
    return f"{sigma.min():.2f}°" if len(sigma) else "–"


if __name__ == "__main__":
    main()
