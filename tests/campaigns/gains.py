"""How well the light of the shots is known, without a chart or with one, and whether what is wrong is told.

python -m tests.campaigns.gains [--objects 20] [--first-seed 0] [--angles 0,45,90] [--chart] [--parts]

Objects of `lit_objects` under a flash that repeats within 2 %. A capture is flagged where the gate `gain doubt`
does not pass, refused where it fails; with --chart where polcap does not find the chart as well. Prints the errors,
the worst shot's of each capture, and what is promised.
"""

import argparse

import numpy as np

from polcap.errors import ChartError
from polcap.formats import shipped_data
from polcap.images import AngleStack, ColorCalibration
from polcap.pipeline.path import AUTO
from polcap.quality import light
from polcap.quality.gate import Evidence
from polcap.quality.limits import GateLimits
from polcap.stages import selfcal, whitebalance
from polcap.stages.selfcal import angles, integrability, object_gains
from tests import scenes
from tests.campaigns import lit_objects

JITTER = 0.02  # 1σ of a pop
GOOD, BAD = 0.003, 0.006
BY_CHART = 0.0015


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--angles", default="0,45,90")
    parser.add_argument("--chart", action="store_true", help="a color chart stands beside the object")
    parser.add_argument("--parts", action="store_true", help="also what each property of the object says")
    given = parser.parse_args()
    angle = np.radians([float(one) for one in given.angles.split(",")])
    rows, errors, states = [], [], []
    for seed in range(given.first_seed, given.first_seed + given.objects):
        case = lit_objects.lit(seed, chart=given.chart)
        true = 1 + JITTER * np.random.default_rng([seed, 13]).normal(size=len(angle))
        true = true / true[0]
        radiance, object_ = lit_objects.stack(case, angle, seed, true), lit_objects.object_of(case)
        settings = selfcal.SelfcalSettings(check_order=False)
        try:
            color = measured(radiance) if given.chart else scenes.no_color()
        except ChartError as refusal:
            print(seed, case.look, "refused:", refusal, flush=True)
            states.append("fail")
            errors.append(np.nan)  # within no limit, beyond none
            continue
        found = selfcal.solve(radiance, scenes.still(len(angle)), object_, color, settings)
        gate = light._gain_doubt(Evidence.partial(selfcal=found), GateLimits())
        error = np.abs(found.gains.gain.mean(1) / true - 1)
        errors.append(float(error.max()))
        sigma = float(found.gains.sigma.max())
        states.append(gate.state)
        rows.append((seed, case.look, f"{100 * errors[-1]:.2f} %", f"{100 * sigma:.2f} %", gate.state))
        if given.parts:
            print(seed, case.look, *parts(radiance, object_, angle, true), flush=True)
    print(lit_objects.shown(rows, ("seed", "look", "worst error", "1σ", "gate")))
    if given.chart:
        print(f"\nwithin {100 * BY_CHART:g} %: {(np.array(errors) <= BY_CHART).sum()} of {len(errors)}")
    off, flagged = np.array(errors), np.array([state != "pass" for state in states])
    print(f"\nwithin {100 * GOOD:g} %: {(off <= GOOD).sum()} of {len(off)}")
    print(f"above {100 * BAD:g} %: {(off > BAD).sum()}, of them unflagged: {((off > BAD) & ~flagged).sum()}")
    print(f"flagged {flagged.sum()}, refused {sum(state == 'fail' for state in states)}")


def measured(radiance: AngleStack) -> ColorCalibration:
    """The chart, as polcap finds it."""
    settings = whitebalance.WhitebalanceSettings()
    return whitebalance.measure(radiance, shipped_data.colorchecker(settings.chart), AUTO, settings)


def parts(radiance, object_, angle, true) -> list[str]:
    """Error and doubt [%] of each shot's gain by each property alone."""
    shots = object_gains.register(radiance, scenes.still(len(angle)), object_)
    facing = object_gains.facing(shots.light, shots.inside, angle)
    found = {
        "facing": facing,
        "outline": object_gains.outline(angles.rim(shots), angle),
        "closure": object_gains.closure(shots.light, shots.inside, angle),
        "slopes": integrability.gains(shots.light, shots.inside, angle, facing.gain),
    }
    return [
        f"{name} "
        + " ".join(f"{100 * (g / t - 1):+.2f}±{100 * s:.2f}" for g, t, s in zip(one.gain[1:], true[1:], one.sigma[1:]))
        for name, one in found.items()
        if np.isfinite(one.sigma).all()
    ]


if __name__ == "__main__":
    main()
