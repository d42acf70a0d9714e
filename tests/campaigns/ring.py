"""Error of the measured zero of the ring, and whether an unsure zero is left uncorrected.

python -m tests.campaigns.ring [--objects 50] [--turns 4] [--first-seed 0] [--no-chart] [--raw] [--rows FILE]

Objects of `lit_objects` (closed shapes and, every third, clusters of thin parts that hide one another) under a flash
with gains known to 0.1 % by a chart, with --no-chart under one that repeats within 1 %; each with several turns of the
ring within ±10°, one of them 0. With --raw whole captures are shot and read, with brackets, nudges and chart. A turn is
corrected where it is sure; every correction should be right within 0.2°.
"""

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.pipeline import models
from polcap.results import ResultsUntilSelfcal
from polcap.stage_values import RingZero
from polcap.stages import selfcal
from polcap.synth import scenes as random_scenes
from polcap.synth import shooting
from tests import scenes
from tests.campaigns import lit_objects
from tests.experiments import Rows, arguments, process, processor_s

_ANGLE = np.radians([0.0, 45.0, 90.0])
_GAIN_ERROR = 0.001  # 1σ of a gain from a chart
_FLASH = 0.01  # 1σ of a pop
_MOST_TURN = 10.0  # degrees
GOOD_DEG = 0.2
KINDS: tuple[Literal["bumps", "clusters", "vase"], ...] = ("bumps", "clusters", "vase")  # clusters are thin


def main() -> None:
    stated = arguments(__doc__, "--no-chart", "--raw", objects=50, turns=4, first_seed=0, rows=Rows())
    rows, done = stated.rows, stated.rows.done("seed", "turn_number", "raw")
    for seed in range(stated.first_seed, stated.first_seed + stated.objects):
        wanted = [t for t in range(stated.turns) if (seed, t, stated.raw) not in done]
        case = lit_objects.lit(seed) if wanted and not stated.raw else None
        for number in wanted:
            turn, chart = planted(seed, number), not stated.no_chart
            found = from_raw(seed, turn) if case is None else at_stokes_level(case, seed, number, turn, chart)
            rows.add({"seed": seed, "turn_number": number, "raw": stated.raw, "planted": turn, **found})
            print(rows.all[-1], flush=True)
    print(summary([row for row in rows.all if row["raw"] == stated.raw]))
    print(f"{processor_s():.0f} s of processor time")


def planted(seed: int, number: int) -> float:
    """True less stated angle of the ring, degrees; the first of every object is 0."""
    turn = np.random.default_rng([seed, 17, number]).uniform(-_MOST_TURN, _MOST_TURN)
    return round(float(turn), 1) if number else 0.0


def at_stokes_level(case: lit_objects.Lit, seed: int, number: int, turn: float, chart: bool) -> dict[str, Any]:
    """Result of selfcal on an object's shots."""
    repeats = _GAIN_ERROR if chart else _FLASH
    gain = 1 + repeats * np.random.default_rng([seed, 18, number]).normal(size=len(_ANGLE))
    radiance = lit_objects.stack(case, _ANGLE + np.radians(turn), seed, gain, _ANGLE)
    if chart:
        spread = _GAIN_ERROR / 2**0.5  # as with a chart
        radiance = replace(radiance, equipment=replace(radiance.equipment, flash_spread=spread))
    settings = selfcal.SelfcalSettings(check_order=False)
    object_, still = lit_objects.object_of(case), scenes.still(len(_ANGLE))
    found = selfcal.solve(radiance, still, object_, scenes.no_color(), settings)
    return error_of(found.ring, KINDS[seed // 2 % 3])


def from_raw(seed: int, turn: float) -> dict[str, Any]:
    """The same on photographs that are shot, read and merged, with a chart and polcap's own mask."""
    kind = KINDS[seed % 3]
    true = tuple(round(float(angle + turn) % 180, 1) for angle in np.degrees(_ANGLE))
    shoot = shooting.Shoot(seed=seed, width=640, height=480, samples=1, angles_deg=true)
    with tempfile.TemporaryDirectory() as place:
        shooting.write(Path(place) / "capture", random_scenes.random_scene(seed, kind), shoot)
        capture = captures.read(Path(place) / "capture")
        nominal = [min(_ANGLE, key=lambda a: _distance(shot.angle - math.radians(turn), a)) for shot in capture.shots]
        shots = tuple(replace(shot, angle=float(a)) for shot, a in zip(capture.shots, nominal))
        try:
            using = None, models.load_mask_network(1)
            results = process(replace(capture, shots=shots), ResultsUntilSelfcal, using)
            return error_of(results.selfcal.ring, kind)
        except InputError as error:
            return {"kind": kind, "refused": str(error)}


def _distance(a: float, b: float) -> float:
    """Between two axes, rad."""
    return abs((a - b + math.pi / 2) % math.pi - math.pi / 2)


def error_of(found: RingZero, kind: str) -> dict[str, Any]:
    """A row: measured turn of the ring, its 1σ and the correction, degrees."""
    turn, sigma, applied = np.degrees([found.offset, found.sigma, found.correction])
    return {"kind": kind, "turn": float(turn), "sigma": float(sigma), "applied": float(applied)}


def summary(rows: list[dict[str, Any]]) -> str:
    """The distribution of errors, of closed and of thin objects."""
    lines = []
    for name, kinds in (("closed", ("bumps", "vase")), ("thin", ("clusters",))):
        some = [row for row in rows if row["kind"] in kinds and "refused" not in row]
        refused = sum(row["kind"] in kinds and "refused" in row for row in rows)
        if not some:
            continue
        true, turn, sigma, applied = (
            np.array([row[k] for row in some]) for k in ("planted", "turn", "sigma", "applied")
        )
        error, off, used = np.abs(turn - true), np.abs(applied - true), applied != 0
        lines.append(
            f"{name}: {len(some)} cases, {refused} refused; error median {np.median(error):.2f}°, "
            f"90 % {np.quantile(error, 0.9):.2f}°; 1σ median {np.median(sigma):.2f}°; "
            f"beyond 3σ {(error > 3 * sigma).sum()}, beyond 2σ {(error > 2 * sigma).sum()}"
        )
        if used.any():
            lines.append(
                f"  applied {used.sum()}: within {GOOD_DEG}° {(off[used] <= GOOD_DEG).sum()}, "
                f"median {np.median(off[used]):.2f}°, 90 % {np.quantile(off[used], 0.9):.2f}°, "
                f"most {off[used].max():.2f}°, worse than stated {(off[used] > np.abs(true[used])).sum()}"
            )
        far = ~used & (np.abs(true) > 1)
        least = f", their 1σ at least {sigma[far].min():.2f}°" if far.any() else ""
        lines.append(f"  not corrected though off by more than 1°: {far.sum()}{least}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
