"""Benchmark of the mesh's cuts at occlusions in simulated captures, processed from RAW to asset.

python tests/benchmarks/bench_mesh_raw.py FOLDER [--only NAME…] [--first-seed N]     (POLCAP_DATA for the meshes)

Photographs objects at the scale of a camera of 24 MP (10,000 px of focal length; the frame is trimmed to object and
chart) and of one of 2 MP, one after another, each taken away once it is measured; FOLDER/rows.jsonl keeps a row for
each, so that a run that was cut short goes on. From the estimated normals, prior and mask: pieces without specks,
slits, share of true contours that are cut, and depth error over the depth range after the best scale, where mask and
truth agree, for the stage and for plain least squares. Prints the rows as a Markdown table. $POLCAP_KEEP_MAPS names a
folder for what it takes to integrate again in other ways.
"""

import argparse
import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from bench_mesh import Case, cut_share, error, slits, true_links, true_pieces

from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.optics.frames import dot
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, distance_m, path
from polcap.results import Results
from polcap.stage_values import SurfaceMaps
from polcap.stages import surface
from polcap.synth import render, scenes, shooting

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--first-seed", type=int, default=40)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows = options.folder / "rows.jsonl"
    known = [json.loads(line) for line in rows.read_text().splitlines()] if rows.exists() else []
    for seed, (size, kind) in enumerate(((s, k) for s in SHOOTS for k in KINDS), options.first_seed):
        name = f"{size} {kind} {seed}"
        if any(row["scene"] == name for row in known) or not any(part in name for part in options.only or [""]):
            continue
        known.append({"scene": name, **measured(options.folder / "capture", size, kind, seed)})
        with rows.open("a") as file:
            file.write(json.dumps(known[-1]) + "\n")
        print(line(known[-1]), flush=True)
    print("\n|", " | ".join(COLUMNS.values()), "|\n" + "| --- " * len(COLUMNS) + "|")
    print("\n".join(map(line, known)))


def line(row: dict[str, Any]) -> str:
    return "| " + " | ".join(str(row[key]) for key in COLUMNS) + " |"


def measured(folder: Path, size: str, kind: str, seed: int) -> dict[str, Any]:
    """A row's figures; the capture is written to `folder` and taken away."""
    start = time.process_time()
    shutil.rmtree(folder, ignore_errors=True)
    scene = scene_of(kind, seed)
    shooting.write(folder, scene, msgspec.structs.replace(SHOOTS[size], seed=seed))
    network, mask_network = models.load_network(None, None), models.load_mask_network()
    supplied = UserInput(network=network, mask_network=mask_network)
    found = path(captures.read(folder, None), supplied, Config(), MemoryCache(), Results)
    maps, mesh, distance = found.maps, found.mesh, distance_m(found.color, found.radiance)
    plain = surface.integrate(maps, distance, surface.SurfaceSettings(stiffness=0.0))
    of, normal = truth(scene, maps)
    if keep := os.environ.get("POLCAP_KEEP_MAPS"):
        save(Path(keep) / f"{size}_{kind.replace('/', '_')}_{seed}.npz", maps, of)
    shutil.rmtree(folder)
    angle = np.degrees(np.arccos(np.clip(dot(maps.normal, normal)[of.maps.mask], -1, 1)))
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


def scene_of(kind: str, seed: int) -> render.Scene:
    if "/" not in kind:
        return scenes.random_scene(seed, kind)  # type: ignore[arg-type]
    file = Path(os.environ["POLCAP_DATA"]) / "meshes" / f"{kind}.npz"
    return scenes.with_model(scenes.random_scene(seed, "vase"), file, seed)


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
