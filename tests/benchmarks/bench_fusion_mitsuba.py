"""Benchmark of the fusion on views that Mitsuba path-traces, under the polarization law of rough surfaces.

    POLCAP_DATA=FOLDER python tests/benchmarks/bench_fusion_mitsuba.py SCENES [--views 12] [--only NAME…]

Poses as in `bench_fusion.py`, but exact. Each view is one scene of `make_mitsuba.py` of the material "rough" (one
albedo, roughness and F0), with the camera errors of `polcap evaluate`; the stages `cues` and `infer` make its maps.
SCENES keeps the scenes, so that a stopped run continues. Prints for each object the mean distance of the seen true
surface from hull and fused mesh, % of the object's size, and mean errors of single views and of the fused maps.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np
from bench_fused_asset import against_truth
from bench_fusion import mean_distance, seen_points
from bench_mitsuba import read
from make_mitsuba import shoot

from polcap.formats import atomic, onnx
from polcap.formats.scene_files import read_mesh
from polcap.fusion.closed_mesh import is_closed, iso_surface
from polcap.fusion.fusion_path import FusionResults, FusionSettings, path
from polcap.fusion.hull import visual_hull
from polcap.fusion.small_views import reduce_views
from polcap.fusion.values import FusionView, Pose
from polcap.images import Floats, Network
from polcap.optics.color import luminance
from polcap.optics.frames import dot
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.stages import infer
from tests.fusion.traced_views import Body, all_around, capture, solid, stand

OBJECTS = ("spot", "demosthenes")
PIXELS, DEPTH = 256, 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--only", nargs="*", default=OBJECTS)
    options = parser.parse_args()
    network = models.load_network("network", None, "cpu", 1)
    assert network is not None
    print("| object | hull % | fused % | Euler | closed | normals ° | diffuse | F0 | roughness |", "\n|", "--- |" * 9)
    for name in options.only:
        print(row(name, options.views, options.scenes, network), flush=True)


def row(name: str, count: int, scenes: Path, network: Network) -> str:
    body = stand(*read_mesh(Path(os.environ["POLCAP_DATA"]) / "meshes/test" / f"{name}.npz"))
    poses = all_around(body, count)
    files = [scenes / f"{name}_{k:02d}_of_{count}.npz" for k in range(count)]
    for file, pose in zip(files, poses):
        if not file.exists():
            trace(body, pose, file)
    pairs = [maps_of(file, pose, network, seed) for seed, (file, pose) in enumerate(zip(files, poses))]
    single = np.mean([errors for _, errors in pairs], axis=0)
    views = tuple(view for view, _ in pairs)
    results = path(views, FusionSettings(), MemoryCache())
    point = seen_points(body, [capture(body, pose) for pose in poses])
    hull = iso_surface(visual_hull(reduce_views(list(views)), FusionSettings().shape.grid))
    percent = [100 * mean_distance(mesh, point) / body.size for mesh in (hull, results.mesh)]
    cells = [f"{one:.3g} → {both:.3g}" for one, both in zip(single, fused_errors(results, body, files[0]))]
    return (
        f"| {name} | {percent[0]:.2f} | {percent[1]:.2f} | {solid(results.mesh).euler_number} | "
        f"{is_closed(results.mesh)} | {' | '.join(cells)} |"
    )


def trace(body: Body, pose: Pose, file: Path) -> None:
    """Render a view; all views of an object draw the same material."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    view = capture(body, pose, PIXELS).view
    placed = pose.rotation, pose.translation, view
    made, about = shoot(mi, body.triangles, placed, "rough", None, PIXELS, DEPTH, np.random.default_rng(2026))
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic.path(file) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, about=np.array(json.dumps(about)), **made)


def maps_of(file: Path, pose: Pose, network: Network, seed: int) -> tuple[FusionView, list[float]]:
    """A view's maps, and their mean errors: normals [degrees], diffuse, F0, roughness."""
    case, _ = read(file, clean=False, rough=False, seed=seed)
    maps, truth = infer.estimate(case.cues, network, onnx.run, infer.InferSettings()), case.truth
    both = maps.mask & truth.mask
    off = np.degrees(np.arccos(np.clip(dot(maps.normal, truth.normal), -1, 1)))
    colors = [luminance(a) - luminance(b) for a, b in ((maps.diffuse, truth.diffuse), (maps.specular, truth.specular))]
    errors = [float(np.abs(one[both]).mean()) for one in (off, *colors, maps.roughness - truth.roughness)]
    light = np.array(json.loads(str(np.load(file)["about"]))["light"])
    view = FusionView(
        file.stem, pose, maps.view, light, maps.mask, maps.normal, maps.confidence, maps.diffuse, maps.specular,
        maps.roughness, case.cues.radiance,
    )  # fmt: skip
    return view, errors


def fused_errors(results: FusionResults, body: Body, file: Path) -> Floats:
    """Mean errors of the fused maps on what views saw, as in `maps_of`; the true material is the same everywhere."""
    with np.load(file) as made:
        truth = {name: made[name][made["mask"]].mean(axis=0) for name in ("diffuse", "specular", "roughness")}
    count = len(body.triangles.vertices)
    return against_truth(results, body.triangles, {name: np.tile(value, (count, 1)) for name, value in truth.items()})


if __name__ == "__main__":
    main()
