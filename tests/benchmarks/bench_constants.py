"""Benchmark of constants in the stages: effect on one capture's errors if each is halved and doubled.

    python tests/benchmarks/bench_constants.py RESULT TRUTH.npz [--rooms align selfcal analytic network]

RESULT is the result of a capture, TRUTH holds its true normals (`normal`, `mask`, on its RAW pixels or
on the grid that they were merged to). Prints one row per number: mean normal error in degrees for those of `infer`,
greatest movement of a corner in px against the default for those of `align`, greatest change of a gain in per cent for
those of `selfcal`, found without the chart. A number that the capture does not feel may matter to another one.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from polcap.config import Config
from polcap.formats import onnx
from polcap.image_values import Floats
from polcap.optics import frames, registration
from polcap.optics.resize import area_mean
from polcap.pipeline import run as pipeline
from polcap.results import Results
from polcap.stage_values import Network
from polcap.stages import align, infer, selfcal
from polcap.stages.infer import analytic, fine, learned, zenith
from polcap.stages.infer.shape import half_turns, planar_faces
from polcap.stages.selfcal import object_gains
from tests.experiments import arguments, head, networks

FACTORS = (0.5, 2.0)
ROOMS = ["align", "selfcal", "analytic", "network"]
ALIGN = {
    align: ("_FLOOR_PX", "_MOST_PIXELS"),
    registration: ("_TILE_ERROR_PX", "_PRIOR_PX", "_AGREE_PX"),
}
SELFCAL: Mapping[ModuleType, tuple[str, ...]] = {
    object_gains: (
        "_PEAK_WIDTH", "_CELL_PX", "_PARTS", "_ANGLE_ERROR", "_FACING_ERROR", "_OUTLINE_ERROR", "_CLOSURE_ERROR",
    ),
}  # fmt: skip
ANALYTIC = {
    analytic: ("_BLURS_PX", "_SAME", "_MODEL_ERROR_DEG"),
    planar_faces: ("_LONGEST",),
    half_turns: ("_INVERSION_OUTLINE", "_INSIDE", "_AHEAD", "_BLUR", "_AROUND"),
    zenith: (
        "_FLAT", "_FLATTEST", "_SMOOTH_LIKELIER", "_DEPOLARIZED_LIKELIER", "_PATCHES", "_UNEVEN", "_RADIUS_SPREAD",
        "_OUTLINE_DEG", "_SHARP",
    ),
}  # fmt: skip
LEARNED: Mapping[ModuleType, tuple[str, ...]] = {
    learned: ("_INVERSION", "_BRIGHTEST"),
    fine: ("_COARSEST",),
    analytic: ("_MODEL_ERROR_DEG", "_SAME"),
    planar_faces: ("_LONGEST", "_OF_ERROR", "_CURVED_DEG", "_SMOOTH"),
    half_turns: ("_OUTLINE", "_INSIDE", "_NETWORK", "_AHEAD", "_BLUR", "_NEAR"),
}


def main() -> None:
    options = arguments(__doc__, "result", "truth", rooms=ROOMS)
    results, _ = pipeline.reopen(options.result, Results)
    print(head("number", "as it is", *(f"× {factor:g}" for factor in FACTORS), ""))
    if "align" in options.rooms:
        table(ALIGN, change(partial(corners, results)), "px of a corner")
    if "selfcal" in options.rooms:
        table(SELFCAL, change(partial(gains, results)), "% of a gain, no chart")
    if "analytic" in options.rooms:
        table(ANALYTIC, partial(normal_error, results, options.truth, None), "° normals, analytic")
    if "network" in options.rooms:
        table(LEARNED, partial(normal_error, results, options.truth, networks()[0]), "° normals, network")


def table(numbers: Mapping[ModuleType, tuple[str, ...]], measure: Callable[[], float], unit: str) -> None:
    """A row per number."""
    usual = measure()
    for module, names in numbers.items():
        for name in names:
            cells = [f"{measured(module, name, factor, measure):.3f}" for factor in FACTORS]
            where = module.__name__.removeprefix("polcap.stages.")
            print(f"| `{where}.{name}` | {usual:.3f} | {' | '.join(cells)} | {unit} |", flush=True)


def measured(module: ModuleType, name: str, factor: float, measure: Callable[[], float]) -> float:
    """The measure with one number changed."""
    usual = getattr(module, name)
    zenith.candidate_laws.cache_clear()  # a table that depends on the numbers
    try:
        setattr(module, name, scaled(usual, factor))
        return measure()
    finally:
        setattr(module, name, usual)
        zenith.candidate_laws.cache_clear()


def scaled(value: Any, factor: float) -> Any:
    """A number, or each of several, times a factor; whole ones stay whole."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    return type(value)(value * factor) if isinstance(value, float) else max(1, round(value * factor))


def normal_error(results: Results, truth: Path, network: Network | None) -> float:
    """Mean error of the estimated normals against the true ones, degrees."""
    cues, (x0, y0, x1, y1) = results.cues, results.object_.crop
    size = results.radiance.value.shape[1:3]
    with np.load(truth) as maps:
        normal, mask = (area_mean(maps[name].astype(np.float32), size)[y0:y1, x0:x1] for name in ("normal", "mask"))
    found = infer.estimate(cues, network, onnx.run, Config().infer).normal
    return float(frames.angle_deg(frames.unit(normal), found)[(mask == 1) & cues.mask].mean())


def change(measure: Callable[[], Floats]) -> Callable[[], float]:
    """How far a measure is from what it is now, at most."""
    usual = measure()
    return lambda: float(np.abs(measure() - usual).max())


def corners(results: Results) -> Floats:
    """Corners (K, 2, 4) px of the picture on the shots."""
    height, width = results.radiance.value.shape[1:3]
    corner = np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]], np.float64)
    moved = align.register(results.radiance, Config().align).transform @ corner
    return np.asarray(moved[:, :2] / moved[:, 2:])


def gains(results: Results) -> Floats:
    """ln of the gains (K, 3) without the chart, per cent."""
    color = replace(results.color, place=None)
    found = selfcal.solve(results.radiance, results.alignment, results.object_, color, Config().selfcal)
    return np.asarray(100 * np.log(found.gains.gain))


if __name__ == "__main__":
    main()
