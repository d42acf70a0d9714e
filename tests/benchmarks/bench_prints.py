"""Benchmark of prints on one gloss: twenty simulated objects with strong prints, RAW to maps, against their truth.

    python tests/benchmarks/bench_prints.py FOLDER [--model ONNX] [--captures 20] [--width 640]

Each object has one roughness and one F0, and a chequer, veins or noise of two colors that differ by .3 to .7. Odd
captures have a rough interface. FOLDER gets the captures, which are made once. `spread` is the standard deviation of
the estimated roughness inside the object, where the true one has none.
"""

import argparse
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.results import Results
from polcap.stage_values import SurfaceMaps
from polcap.synth import shooting
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.scenes import random_scene

ROWS = ("roughness", "estimated", "spread", "error", "F0 error", "normal mean")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--captures", type=int, default=20)
    parser.add_argument("--width", type=int, default=640, help="RAW px, 4:3")
    options = parser.parse_args()
    supplied = UserInput(
        network=models.load_network(None, options.model, "cpu", 1), mask_network=models.load_mask_network(1)
    )
    print("| capture |", " | ".join(ROWS), "|\n| --- |", " --- |" * len(ROWS))
    rows = []
    for number in range(options.captures):
        scene, folder = printed(number), options.folder / f"{number:02d}"
        if not folder.exists():
            shoot = shooting.Shoot(seed=number, width=options.width, height=options.width * 3 // 4)
            shooting.write(folder, scene, shoot)
        found = path(captures.read(folder), supplied, Config(), MemoryCache(), Results).maps
        rows.append(measure(folder, found, scene.coat.materials[0]))
        print(f"| {folder.name} |", " | ".join(f"{x:.3g}" for x in rows[-1]), "|", flush=True)
    print("| mean |", " | ".join(f"{x:.3g}" for x in np.mean(rows, axis=0)), "|")


def printed(number: int) -> Scene:
    """Scene `number`: one gloss under a print."""
    random = np.random.default_rng([number, 0x9217])
    scene = random_scene(4000 + number, ("bumps", "clusters", "vase")[number % 3])
    (r, g, b), dark = random.uniform(0.4, 0.85, 3).tolist(), random.uniform(0.03, 0.15, 3).tolist()
    pattern: Literal["chequer", "veins", "noise"] = ("chequer", "veins", "noise")[number // 3 % 3]
    material = Material(
        first=(r, g, b), second=(dark[0], dark[1], dark[2]), pattern=pattern,
        size=float(random.uniform(0.01, 0.03)), roughness=(float(random.uniform(0.2, 0.7)),) * 2,
        ior=float(random.uniform(1.45, 1.58)), seed=number,
    )  # fmt: skip
    return msgspec.structs.replace(scene, coat=Coat((material,)), law="rough" if number % 2 else "smooth")


def measure(folder: Path, maps: SurfaceMaps, material: Material) -> list[float]:
    """One capture's figures, in the order of ROWS."""
    step, (x0, y0) = round(maps.view.scale), (round(at * maps.view.scale) for at in maps.view.origin)
    height, width = maps.mask.shape
    with np.load(folder / "truth.npz") as file:
        cut = np.s_[y0 : y0 + step * height : step, x0 : x0 + step * width : step]
        normal, inside = file["normal"][cut].astype(np.float32), maps.mask & (file["mask"][cut] == 1)
    rough, f0 = maps.roughness[inside], maps.specular[inside].mean(axis=-1)
    true_f0 = ((material.ior - 1) / (material.ior + 1)) ** 2
    angle = np.degrees(np.arccos(np.clip((normal * maps.normal).sum(-1)[inside], -1, 1)))
    error = float(np.sqrt(np.mean((rough - material.roughness[0]) ** 2)))
    f0_error = float(np.sqrt(np.mean((f0 - true_f0) ** 2)))
    return [material.roughness[0], float(rough.mean()), float(rough.std()), error, f0_error, float(angle.mean())]


if __name__ == "__main__":
    main()
