"""Benchmark of the cross-polarized shot: error of the albedo in clipped highlights, with the shot and without.

python -m tests.benchmarks.bench_crossed [--captures 12] [--width 512] [--estimator analytic] [--no-chart]

Captures of `polcap synth` with `cross=true`, exposed so that highlights clip in the darkest frame: bumps, clusters and
vases of roughness .15 to .25, a stop over what suits them. Prints a Markdown row per capture: the share of the object
that is clipped, the mean error of the diffuse albedo there without the crossed shot and with it, the same over all
gloss that is at least a tenth of the light, and over the rest.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from polcap.formats.capture import reader as captures
from polcap.image_values import Quality
from polcap.optics.resize import block_means
from polcap.results import ResultsUntilInfer
from polcap.synth import scenes, shooting
from tests.experiments import Networks, arguments, head, networks, process, row, with_materials

ESTIMATORS = (None, "network", "analytic")
NAMES = ("clipped", "without", "with", "gloss without", "gloss with", "elsewhere without", "elsewhere with")


def main() -> None:
    options = arguments(
        __doc__, "--no-chart", captures=12, first_seed=0, width=640, estimator=(None, "network", "analytic")
    )
    using, chart = networks(options.estimator), "none" if options.no_chart else "auto"
    print(head("seed", *NAMES))
    rows = []
    for seed in range(options.first_seed, options.first_seed + options.captures):
        with tempfile.TemporaryDirectory() as place:
            rows.append(measure(Path(place), seed, options.width, using, chart))
        print(row(seed, *rows[-1]), flush=True)
    print(row("mean", *np.nanmean(rows, axis=0)))


def measure(place: Path, seed: int, width: int, using: Networks, chart: str) -> list[float]:
    """The figures of `NAMES` for one capture."""
    kinds = get_args(scenes.Kind)
    shoot = shooting.Shoot(seed=seed, width=width, height=width * 3 // 4, samples=1, cross=True, exposure_factor=2.0)
    scene = scenes.random_scene(seed, kinds[seed % len(kinds)])
    gloss = (0.15, 0.2, 0.25)[seed // 3 % 3]
    shooting.write(place / "capture", with_materials(scene, roughness=(gloss, gloss)), shoot)
    capture = captures.read(place / "capture", None)
    both = [process(one, ResultsUntilInfer, using, chart) for one in (replace(capture, crossed=None), capture)]
    without, with_it = (found.maps for found in both)
    x0, y0, x1, y1 = both[1].object_.crop
    with np.load(place / "capture" / "truth.npz") as truth:
        albedo, inside = (block_means(truth[k].astype(np.float32), 2) for k in ("diffuse", "mask"))
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


if __name__ == "__main__":
    main()
