"""Benchmark of the cross-polarized shot: error of the albedo in clipped highlights, with the shot and without.

python -m tests.benchmarks.bench_crossed [--captures 12] [--width 512] [--estimator analytic] [--no-chart]

Captures of `polcap synth` with `cross=true`, exposed so that highlights clip in the darkest frame: bumps, clusters and
vases of roughness .15 to .25, a stop over what suits them. Prints a Markdown row per capture: the share of the object
that is clipped, the mean error of the diffuse albedo there without the crossed shot and with it, the same over all
gloss that is at least a tenth of the light, and over the rest.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from msgspec import structs

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.image_values import Floats, Quality
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.results import ResultsUntilInfer
from polcap.stage_values import Network
from polcap.synth import scenes, shooting

NAMES = ("clipped", "without", "with", "gloss without", "gloss with", "elsewhere without", "elsewhere with")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--estimator", choices=("network", "analytic"))
    parser.add_argument("--no-chart", action="store_true")
    given = parser.parse_args()
    network = models.load_network(given.estimator, None, "cpu", 1)
    print("| seed |", " | ".join(NAMES), "|\n|" + " --- |" * (len(NAMES) + 1))
    rows = []
    for seed in range(given.first_seed, given.first_seed + given.captures):
        with tempfile.TemporaryDirectory() as place:
            rows.append(measure(Path(place), seed, given.width, network, "none" if given.no_chart else "auto"))
        print(f"| {seed} |", " | ".join(f"{value:.4f}" for value in rows[-1]), "|", flush=True)
    print("| mean |", " | ".join(f"{value:.4f}" for value in np.nanmean(rows, axis=0)), "|")


def measure(place: Path, seed: int, width: int, network: Network | None, chart: str) -> list[float]:
    """The figures of `NAMES` for one capture."""
    kinds = get_args(scenes.Kind)
    shoot = shooting.Shoot(seed=seed, width=width, height=width * 3 // 4, samples=1, cross=True, exposure_factor=2.0)
    scene = scenes.random_scene(seed, kinds[seed % len(kinds)])
    gloss = (0.15, 0.2, 0.25)[seed // 3 % 3]
    worn = tuple(structs.replace(one, roughness=(gloss, gloss)) for one in scene.coat.materials)
    shooting.write(place / "capture", structs.replace(scene, coat=structs.replace(scene.coat, materials=worn)), shoot)
    capture = captures.read(place / "capture", None)
    alike = replace(capture, crossed=None), capture
    both = [solved(one, place / str(k), network, chart) for k, one in enumerate(alike)]
    without, with_it = (found.maps for found in both)
    x0, y0, x1, y1 = both[1].object_.crop
    with np.load(place / "capture" / "truth.npz") as truth:
        albedo, inside = (_binned(truth[k].astype(np.float32)) for k in ("diffuse", "mask"))
    albedo, inside = albedo[y0:y1, x0:x1], (inside[y0:y1, x0:x1] == 1) & with_it.mask & without.mask
    clipped = inside & ((both[1].stokes.quality & int(Quality.CLIPPED)) > 0)
    cues = both[1].cues
    assert cues.body is not None
    glossy = inside & ((cues.body.sum(-1) < 0.9 * cues.radiance.sum(-1)) | clipped)
    areas = [(maps, area) for area in (clipped, glossy, inside & ~glossy) for maps in (without, with_it)]
    return [
        float(clipped.sum() / inside.sum()),
        *(float(np.abs(maps.diffuse - albedo)[area].mean()) if area.any() else float("nan") for maps, area in areas),
    ]


def solved(capture: Capture, out: Path, network: Network | None, chart: str) -> ResultsUntilInfer:
    """The path's results."""
    request = ChartRequest("none" if chart == "none" else "auto")
    supplied = UserInput(chart=request, network=network, mask_network=models.load_mask_network(1))
    return path(capture, supplied, Config(), MemoryCache(), ResultsUntilInfer)


def _binned(image: Floats) -> Floats:
    """2×2 RAW pixels in one."""
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main()
