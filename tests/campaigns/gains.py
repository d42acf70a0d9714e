"""Error of each shot's gain, without a chart or with one, and whether a wrong gain is flagged.

python -m tests.campaigns.gains [--objects 20] [--first-seed 0] [--angles 0,45,90] [--chart] [--parts]

Objects of `lit_objects` under a flash that repeats within 2 %. A capture is flagged where the gate `gain doubt` does
not pass, refused where the gate fails; with --chart also where polcap does not find the chart. Prints the errors, the
worst shot's of each capture, and the promised figures; with --parts also error and 1σ by each property of the object.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.errors import ChartError
from polcap.formats import shipped_data
from polcap.pipeline.path import AUTO
from polcap.quality import shot_exposure
from polcap.quality.limits import GateLimits
from polcap.stage_values import AngleStack
from polcap.stages import selfcal, whitebalance
from polcap.stages.selfcal import angles, integrability, object_gains
from tests import scenes
from tests.campaigns import lit_objects
from tests.experiments import arguments, table

JITTER = 0.02  # 1σ of a pop
GOOD, BAD = 0.003, 0.006
BY_CHART = 0.0015


def main() -> None:
    stated = arguments(__doc__, "--chart", "--parts", objects=20, first_seed=0, angles="0,45,90")
    angle = np.radians([float(one) for one in stated.angles.split(",")])
    rows, errors, states = [], [], []
    for seed in range(stated.first_seed, stated.first_seed + stated.objects):
        case = lit_objects.lit(seed, chart=stated.chart)
        true = 1 + JITTER * np.random.default_rng([seed, 13]).normal(size=len(angle))
        true = true / true[0]
        radiance, object_ = lit_objects.stack(case, angle, seed, true), lit_objects.object_of(case)
        try:
            color = measured(radiance) if stated.chart else scenes.no_color()
        except ChartError as refusal:
            print(seed, case.finish, "refused:", refusal, flush=True)
            states.append("fail")
            errors.append(np.nan)  # within no limit, beyond none
            continue
        settings = selfcal.SelfcalSettings(check_order=False)
        found = selfcal.solve(radiance, scenes.still(len(angle)), object_, color, settings)
        results = SimpleNamespace(selfcal=found, radiance=radiance)
        evidence: Any = SimpleNamespace(results=results, names=stated.angles.split(","))
        states.append(shot_exposure.gain_doubt(evidence, GateLimits()).state)
        errors.append(float(np.abs(found.gains.gain.mean(1) / true - 1).max()))
        sigma = float(found.gains.sigma.max())
        rows.append((seed, case.finish, f"{100 * errors[-1]:.2f} %", f"{100 * sigma:.2f} %", states[-1]))
        if stated.parts:
            print(seed, case.finish, *parts(radiance, object_, angle, true), flush=True)
    print(table(rows, ("seed", "finish", "worst error", "1σ", "gate")), "\n")
    error, flagged = np.array(errors), np.array([state != "pass" for state in states])
    for limit in (BY_CHART, GOOD):
        print(f"within {100 * limit:g} %: {(error <= limit).sum()} of {len(error)}")
    print(f"above {100 * BAD:g} %: {(error > BAD).sum()}, of them unflagged: {((error > BAD) & ~flagged).sum()}")
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
