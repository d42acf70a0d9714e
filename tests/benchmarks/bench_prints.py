"""Benchmark of prints on one gloss: twenty simulated objects with strong prints, RAW to maps, against their truth.

    python tests/benchmarks/bench_prints.py FOLDER [--model ONNX] [--captures 20] [--width 640]

Each object has one roughness and one F0, and a chequer, veins or noise of two colors that differ by .3 to .7. Odd
captures have a rough interface. FOLDER gets the captures, which are made once. `spread` is the standard deviation of
the estimated roughness inside the object, where the true one has none.
"""

from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from polcap.formats.capture import reader as captures
from polcap.optics import frames
from polcap.results import ResultsUntilInfer
from polcap.stage_values import SurfaceMaps
from polcap.synth import shooting
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.scenes import random_scene
from tests.experiments import arguments, head, networks, process, raw_pixels, rms, row

ROWS = ("roughness", "estimated", "spread", "error", "F0 error", "normal mean")


def main() -> None:
    options = arguments(__doc__, "folder", model=Path, captures=20, width=640)
    using = networks(model=options.model)
    print(head("capture", *ROWS))
    rows = []
    for number in range(options.captures):
        scene, folder = printed(number), options.folder / f"{number:02d}"
        if not folder.exists():
            shoot = shooting.Shoot(seed=number, width=options.width, height=options.width * 3 // 4)
            shooting.write(folder, scene, shoot)
        found = process(captures.read(folder), ResultsUntilInfer, using).maps
        rows.append(measure(folder, found, scene.coat.materials[0]))
        print(row(folder.name, *rows[-1]), flush=True)
    print(row("mean", *np.mean(rows, axis=0)))


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
    step, cut = raw_pixels(maps)
    with np.load(folder / "truth.npz") as file:
        normal, mask = (file[name][cut][::step, ::step].astype(np.float32) for name in ("normal", "mask"))
    inside = maps.mask & (mask == 1)
    rough, f0 = maps.roughness[inside], maps.specular[inside].mean(axis=-1)
    true_f0 = ((material.ior - 1) / (material.ior + 1)) ** 2
    true_rough, angle = material.roughness[0], frames.angle_deg(normal, maps.normal)[inside]
    means = float(rough.mean()), float(rough.std())
    return [true_rough, *means, rms(rough - true_rough), rms(f0 - true_f0), float(angle.mean())]


if __name__ == "__main__":
    main()
