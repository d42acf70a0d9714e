"""Benchmark of the expected errors: those that polcap states for each pixel, against the true ones.

    python tests/benchmarks/bench_expected_errors.py DATA [--seeds 1-12] [--width 640]

Simulates captures without a fault ("good"), with clipped light, with one blurred shot, and of meshes with
interreflection under a flash at the lens ("mesh") or 20 cm away ("shadow"). Prints for each kind: stated over actual
normal error in tenths of the stated one; root mean square of error over stated 1σ of albedo and roughness.
"""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter

from polcap.config import Config
from polcap.formats.capture import reader
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.resize import block_means, weighted_area_mean
from polcap.quality import error_maps, gates
from polcap.quality.gate_values import full_size
from polcap.results import ResultsUntilInfer
from polcap.stage_values import SurfaceMaps
from polcap.synth import scenes, shooting
from polcap.training import traced_views
from tests.experiments import arguments, process, raw_pixels

KINDS = ("good", "clipped", "blur", "mesh", "shadow")
PIXELS = 3000  # of each capture


def main() -> None:
    options = arguments(__doc__, "data", seeds="1-12", width=640)
    first, last = map(int, options.seeds.split("-"))
    for kind in KINDS:
        seeds = range(first, last + 1)
        found = np.concatenate([drawn(options.data, kind, seed, options.width) for seed in seeds], axis=1)
        order = np.argsort(found[0])
        tenths = " ".join(f"{found[0, p].mean() / found[1, p].mean():.2f}" for p in np.array_split(order, 10))
        albedo, rough = (np.sqrt(np.mean((found[k + 1] / found[k]) ** 2)) for k in (2, 4))
        print(f"{kind:8} normals {tenths}   albedo {albedo:.2f}   roughness {rough:.2f}", flush=True)


def drawn(data: Path, kind: str, seed: int, width: int) -> Floats:
    """Stated and true error (6, N) of normals, albedo and roughness of some pixels of a capture."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "capture"
        shoot(data, place, kind, seed, width)
        capture = reader.read(place)
        results = process(capture, ResultsUntilInfer)
        truth = dict(np.load(place / "truth.npz"))
    evidence = full_size(results, capture.focal_doubt)
    maps = error_maps.with_errors(evidence, gates.judge(evidence, Config().gates))
    assert maps.diffuse_error is not None and maps.roughness_error is not None
    true, seen = on_grid(truth, maps)
    pairs = (
        (maps.confidence, frames.angle_deg(true["normal"], maps.normal)),
        (maps.diffuse_error, np.abs((maps.diffuse - true["diffuse"]).mean(-1))),
        (maps.roughness_error, np.abs(maps.roughness - true["roughness"])),
    )
    some = np.random.default_rng(seed).permutation(int(seen.sum()))[:PIXELS]
    return np.stack([image[seen][some] for pair in pairs for image in pair])


def shoot(data: Path, place: Path, kind: str, seed: int, width: int) -> None:
    """Write a simulated capture of a kind."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    scene = scenes.random_scene(seed, ("bumps", "clusters", "vase")[seed % 3])
    how = shooting.Shoot(seed=seed, width=width, height=width * 3 // 8 * 2, samples=1, gain_jitter=0.003)
    if kind in ("mesh", "shadow"):
        files = traced_views.training_meshes(data)
        scene = scenes.with_model(scene, files[int(random.integers(len(files)))], seed)
        light = (0.15, 0.15, 0.0) if kind == "shadow" else scene.light
        scene = msgspec.structs.replace(scene, interreflection=True, light=light)
    if kind == "clipped":
        how = msgspec.structs.replace(how, exposure_factor=float(random.uniform(4, 20)))
    studio = shooting.Studio(scene, how)
    if kind == "blur":
        blurred = int(random.integers(1, 3))
        radiance, taken = studio.radiance, iter(range(3))
        blur = partial(gaussian_filter, sigma=float(random.uniform(1.2, 4)), axes=(0, 1))
        studio.radiance = lambda *pose, **more: (  # type: ignore[method-assign]
            blur(radiance(*pose, **more)) if next(taken) == blurred else radiance(*pose, **more)
        )
    shooting.write_capture(place, studio)


def on_grid(truth: dict[str, Any], maps: SurfaceMaps) -> tuple[dict[str, Floats], Bools]:
    """True maps on the grid of the maps, and the pixels (H, W) where both show the object."""
    step, cut = raw_pixels(maps)
    inside = truth["mask"][cut]
    names = ("normal", "diffuse", "roughness")
    found = {n: weighted_area_mean(truth[n][cut].astype(np.float32), inside, maps.mask.shape) for n in names}
    found["normal"] = frames.unit(found["normal"])
    return found, (block_means(inside > 0, step) == 1) & maps.mask


if __name__ == "__main__":
    main()
