"""Benchmark of the mesh's cuts at occlusions in simulated captures, processed from RAW to asset.

python tests/benchmarks/bench_mesh_raw.py FOLDER [--only NAME…] [--first-seed N]     (POLCAP_DATA for the meshes)

Photographs objects at the scale of a camera of 24 MP (10,000 px of focal length; the frame is trimmed to object and
chart) and of one of 2 MP, one after another, each taken away once it is measured; FOLDER/rows.jsonl keeps a row for
each, so that a run that was cut short goes on. From the estimated normals, prior and mask: pieces without specks,
slits, share of true contours that are cut, and depth error over the depth range after the best scale, where mask and
truth agree, for the stage and for plain least squares. Prints the rows as a Markdown table. $POLCAP_KEEP_MAPS names a
folder for what it takes to integrate again in other ways.
"""

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from bench_mesh import Case, cut_share, error, scene_of, slits, true_links, true_pieces

from polcap.formats.capture import reader as captures
from polcap.optics import frames
from polcap.pipeline.path import distance_m
from polcap.results import Results
from polcap.stage_values import SurfaceMaps
from polcap.stages import surface
from polcap.synth import render, shooting
from tests.experiments import Rows, arguments, process, table

SHOOTS = {
    "24MP": shooting.Shoot(width=4800, height=2880, focal_mm=75.0, samples=1, exposures=2),
    "2MP": shooting.Shoot(width=1732, height=1154, samples=2, exposures=2),
}
KINDS = (
    "clusters", "vase", "test/mug", "bumps", "train/teapot", "test/spot", "test/demosthenes", "train/pitcher",
    "test/penguin", "train/wingnut",
)  # fmt: skip
COLUMNS = {
    "scene": "scene", "pixels": "MP", "normal_deg": "normals °", "true_pieces": "true pieces", "pieces": "pieces",
    "cuts": "cuts", "slit_px": "slit px", "contours": "contours cut", "plain": "least squares", "ours": "depth",
    "seconds": "CPU s",
}  # fmt: skip


def main() -> None:
    options = arguments(__doc__, "folder", only=[""], first_seed=40)
    rows = Rows(options.folder / "rows.jsonl")
    for seed, (size, kind) in enumerate(((s, k) for s in SHOOTS for k in KINDS), options.first_seed):
        name = f"{size} {kind} {seed}"
        if (name,) not in rows.done("scene") and any(part in name for part in options.only):
            rows.add({"scene": name, **measured(options.folder / "capture", size, kind, seed)})
            print(rows.all[-1], flush=True)
    print(table([[one[key] for key in COLUMNS] for one in rows.all], list(COLUMNS.values())))


def measured(folder: Path, size: str, kind: str, seed: int) -> dict[str, Any]:
    """A row's figures; the capture is written to `folder` and taken away."""
    start = time.process_time()
    shutil.rmtree(folder, ignore_errors=True)
    scene = scene_of(kind, seed)
    shooting.write(folder, scene, msgspec.structs.replace(SHOOTS[size], seed=seed))
    found = process(captures.read(folder, None), Results)
    maps, mesh, distance = found.maps, found.mesh, distance_m(found.color, found.radiance)
    plain = surface.integrate(maps, distance, surface.SurfaceSettings(stiffness=0.0))
    of, normal = truth(scene, maps)
    if keep := os.environ.get("POLCAP_KEEP_MAPS"):
        save(Path(keep) / f"{size}_{kind.replace('/', '_')}_{seed}.npz", maps, of)
    shutil.rmtree(folder)
    angle = frames.angle_deg(maps.normal, normal)[of.maps.mask]
    return {
        "pixels": round(float(maps.mask.sum()) / 1e6, 2),
        "normal_deg": round(float(angle.mean()), 2),
        "true_pieces": true_pieces(of),
        "pieces": mesh.pieces,
        "cuts": round(mesh.cuts, 3),
        "slit_px": round(slits(mesh, of)),
        "contours": f"{cut_share(mesh, of):.0%}",
        "plain": round(error(plain, of), 4),
        "ours": round(error(mesh, of), 4),
        "seconds": round(time.process_time() - start),
    }


def truth(scene: render.Scene, maps: SurfaceMaps) -> tuple[Case, Any]:
    """Depth, contours and normals of the object on the maps' grid, where their mask lies on it."""
    bare = msgspec.structs.replace(scene, chart=None)
    height, width = maps.mask.shape
    seen = render.gbuffer(bare, maps.view, height, width)
    mask = maps.mask & seen.mask
    links = [true_links(bare, maps.view, seen.depth, mask, axis) for axis in (1, 0)]
    return Case(replace(maps, mask=mask), seen.depth, *links), seen.normal


def save(file: Path, maps: SurfaceMaps, of: Case) -> None:
    """What it takes to integrate again, in other ways."""
    prior = np.zeros((0, 0)) if maps.depth_prior is None else maps.depth_prior
    np.savez(
        file, normal=maps.normal.astype(np.float16), prior=prior.astype(np.float32),
        confidence=maps.confidence.astype(np.float16), mask=maps.mask, true=of.maps.mask, depth=of.depth,
        right=of.right, down=of.down, view=np.array([maps.view.focal, *maps.view.center]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
