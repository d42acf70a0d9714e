"""Benchmark of constants in the stages: effect on one capture's errors if each is halved and doubled.

    python tests/benchmarks/bench_constants.py RESULT TRUTH.npz [align selfcal analytic network]

RESULT is what `polcap process` made of a capture whose true normals TRUTH holds (`normal`, `mask`, on its RAW pixels or
on the grid that they were merged to). Prints one row per number: mean normal error in degrees for those of `infer`,
greatest movement of a corner in px against the default for those of `align`, greatest change of a gain in per cent for
those of `selfcal`, found without the chart. A number that the capture does not feel may matter to another one.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from polcap.config import Config
from polcap.formats import onnx
from polcap.image_values import Floats
from polcap.optics import registration
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.results import Results
from polcap.stage_values import Network
from polcap.stages import align, infer, selfcal
from polcap.stages.infer import analytic, fine, learned, zenith
from polcap.stages.infer.shape import half_turns, planar_faces
from polcap.stages.selfcal import object_gains

FACTORS = (0.5, 2.0)
ROOMS = ["align", "selfcal", "analytic", "network"]
ALIGN = {
    align: ("_FLOOR_PX", "_MOST_PIXELS"),
    registration: ("_TILE_ERROR_PX", "_PRIOR_PX", "_AGREE_PX"),
}
SELFCAL: Mapping[ModuleType, tuple[str, ...]] = {
    object_gains: (
        "_PEAK_WIDTH",
        "_CELL_PX",
        "_PARTS",
        "_ANGLE_ERROR",
        "_FACING_ERROR",
        "_OUTLINE_ERROR",
        "_CLOSURE_ERROR",
    ),
}
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("rooms", nargs="*", default=ROOMS, help=f"of {', '.join(ROOMS)}; all by default")
    options = parser.parse_args()
    results, _ = pipeline.reopen(options.result, Results)
    print(f"| number | as it is | × {FACTORS[0]:g} | × {FACTORS[1]:g} | |\n| --- | --- | --- | --- | --- |")
    if "align" in options.rooms:
        table(ALIGN, Moved(results), "px of a corner")
    if "selfcal" in options.rooms:
        table(SELFCAL, Gained(results), "% of a gain, no chart")
    if "analytic" in options.rooms:
        table(ANALYTIC, Normals(Judge(results, options.truth), None), "° normals, analytic")
    if "network" in options.rooms:
        network = models.load_network(None, None, "cpu", 1)
        table(LEARNED, Normals(Judge(results, options.truth), network), "° normals, network")


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
    setattr(module, name, scaled(usual, factor))
    clear_laws()
    try:
        return measure()
    finally:
        setattr(module, name, usual)
        clear_laws()


def scaled(value: Any, factor: float) -> Any:
    """A number, or each of several, times a factor; whole ones stay whole."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    return type(value)(value * factor) if isinstance(value, float) else max(1, round(value * factor))


def clear_laws() -> None:
    """Clear the cached tables, which depend on the numbers."""
    for name in ("candidate_laws",):
        getattr(getattr(zenith, name), "cache_clear", lambda: None)()


class Judge:
    """The true normals on the crop of the maps."""

    def __init__(self, results: Results, truth: Path) -> None:
        self.cues = results.cues
        x0, y0, x1, y1 = results.object_.crop
        with np.load(truth) as maps:
            normal, mask = maps["normal"].astype(np.float32), maps["mask"].astype(np.float32)
        height, width = results.radiance.value.shape[1:3]
        grid = [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in (normal, mask)]
        self.normal, inside = grid[0][y0:y1, x0:x1], grid[1][y0:y1, x0:x1]
        self.normal = self.normal / np.maximum(np.linalg.norm(self.normal, axis=-1, keepdims=True), 1e-6)
        self.inside = (inside == 1) & self.cues.mask

    def error(self, normal: Floats) -> float:
        """Mean error of normals (H, W, 3), degrees."""
        cosine = np.clip((self.normal * normal).sum(-1)[self.inside], -1, 1)
        return float(np.degrees(np.arccos(cosine)).mean())


class Normals:
    """The estimator's mean normal error, degrees."""

    def __init__(self, judge: Judge, network: Network | None) -> None:
        self.judge, self.network = judge, network

    def __call__(self) -> float:
        return self.judge.error(infer.estimate(self.judge.cues, self.network, onnx.run, Config().infer).normal)


class Moved:
    """How far the corners of the shots move against the registration as it is, px."""

    def __init__(self, results: Results) -> None:
        self.radiance, self.color = results.radiance, results.color
        height, width = self.radiance.value.shape[1:3]
        self.corners = np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]], np.float64)
        self.usual = self.places()

    def places(self) -> Floats:
        """Corners (K, 2, 4) px on the shots."""
        moved = align.register(self.radiance, self.color, Config().align).transform @ self.corners
        return np.asarray(moved[:, :2] / moved[:, 2:])

    def __call__(self) -> float:
        return float(np.abs(self.places() - self.usual).max())


class Gained:
    """How far gains without the chart are from those as they are, per cent."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.usual = self.gains()

    def gains(self) -> Floats:
        """(K, 3)."""
        return selfcal.solve(
            self.results.radiance,
            self.results.alignment,
            self.results.object_,
            replace(self.results.color, place=None),
            Config().selfcal,
        ).gains.gain

    def __call__(self) -> float:
        return float(100 * np.abs(self.gains() / self.usual - 1).max())


if __name__ == "__main__":
    main()
