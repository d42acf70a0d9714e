"""Benchmark of flat and sharp-edged things: thirty simulated captures by kind, RAW to maps, against their truth.

    python tests/benchmarks/bench_flat.py FOLDER [--model ONNX] [--captures 30] [--width 640]

Plates with relief, coins, sheets, boxes, books and cans in turn, each at five tilts; the first of five pairs of laws is
smooth. Shapes are those of `training/flat_shapes.py` with seeds that training does not use. FOLDER gets the captures,
which are made once. Prints a Markdown row per capture and the means by kind. `plane` is the error of a guess: a plane
with the true mean normal. `warned`: gates that are not quiet.
"""

import argparse
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.image_values import Floats
from polcap.optics.mesh_tracer import Triangles, centred
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.quality import gates
from polcap.quality.gate_values import full_size
from polcap.results import Results
from polcap.synth import shooting
from polcap.synth.distance_fields import Model
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from polcap.training import flat_shapes

ROWS = ("normal mean", "median", "expected", "plane", "diffuse", "roughness", "F0")
SOLID, PLANE = (25.0, 35.0, 45.0, 55.0, 40.0), (0.0, 5.0, 16.0, 30.0, 50.0)  # deg, tilts
KINDS = {
    "plate": (flat_shapes._slab, PLANE), "coin": (flat_shapes._coin, PLANE), "sheet": (flat_shapes._sheet, PLANE),
    "box": (flat_shapes._box, SOLID), "book": (flat_shapes._book, SOLID), "can": (flat_shapes._can, SOLID),
}  # fmt: skip
RADIUS = 0.07  # m, of the smallest sphere around the object
SEED = 90210  # of shapes and poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--captures", type=int, default=30)
    parser.add_argument("--width", type=int, default=640, help="RAW px, 4:3")
    options = parser.parse_args()
    supplied = UserInput(
        network=models.load_network(None, options.model, "cpu", 1), mask_network=models.load_mask_network(1)
    )
    print("| capture | law |", " | ".join(ROWS), "| warned |\n| --- | --- |", " --- |" * (len(ROWS) + 1))
    table: dict[str, list[list[float]]] = {}
    for number in range(options.captures):
        kind = list(KINDS)[number % len(KINDS)]
        folder = options.folder / f"{number:02d}_{kind}"
        scene = draw(number, kind, options.folder)
        if not folder.exists():
            shooting.write(
                folder, scene, shooting.Shoot(seed=number, width=options.width, height=options.width * 3 // 4)
            )
        capture = captures.read(folder)
        found = path(capture, supplied, Config(), MemoryCache(), Results)
        lines = gates.judge(full_size(found, capture.focal_doubt), Config().gates)
        warned = ", ".join(f"{line.name} {line.state}" for line in lines if line.state in ("warn", "fail"))
        row = errors(found, folder)
        for name in (kind, str(scene.law), "all"):
            table.setdefault(name, []).append(row)
        print(f"| {folder.name} | {scene.law} |", " | ".join(f"{x:.3g}" for x in row), f"| {warned} |", flush=True)
    for name, rows in table.items():
        print(f"| mean of {len(rows)} | {name} |", " | ".join(f"{x:.3g}" for x in np.mean(rows, axis=0)), "| |")


def draw(number: int, kind: str, folder: Path) -> Scene:
    """The scene of a capture; its mesh is written to `folder`."""
    make, tilts = KINDS[kind]
    random = np.random.default_rng([SEED, number, zlib.crc32(kind.encode())])
    mesh = centred(make(random))
    file = folder / f"{number:02d}_{kind}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_mesh(file, mesh)
    round_ = number // len(KINDS)
    axis = random.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.radians(tilts[round_ % 5]) * np.array([np.cos(axis), np.sin(axis), 0]))
    turn = tilt * Rotation.from_rotvec([0, 0, random.uniform(-0.2, 0.2)])
    scene = random_scene(7000 + number, "bumps")  # its material, light and chart
    model = Model(str(file), RADIUS)
    x, y, z = turn.as_rotvec(degrees=True).tolist()
    law: Any = ("smooth", "rough")[(number + round_) % 2]
    return Scene(
        shape=model, coat=scene.coat, position=scene.position, light=scene.light, chart=scene.chart, law=law,
        turn_deg=(x, y, z), interreflection=True,
    )  # fmt: skip


def write_mesh(file: Path, mesh: Triangles) -> None:
    """Write a mesh as the training meshes are."""
    low, scale = mesh.vertices.min(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    quantized = np.round((mesh.vertices - low) / scale * 65535).astype(np.uint16)
    np.savez_compressed(file, vq=quantized, vmin=low, vscale=np.float32(scale), faces=mesh.faces)


def errors(found: Results, folder: Path) -> list[float]:
    """Errors of the maps in the order of ROWS; angles in degrees, RMSE of the materials."""
    maps = found.maps
    step, (x0, y0) = round(maps.view.scale), (round(at * maps.view.scale) for at in maps.view.origin)
    height, width = maps.mask.shape
    with np.load(folder / "truth.npz") as file:
        stored = {name: file[name] for name in ("normal", "mask", "diffuse", "specular", "roughness")}

    def truth(name: str) -> Floats:
        cut = stored[name][y0 : y0 + step * height, x0 : x0 + step * width].astype(np.float32)
        return np.asarray(cut.reshape(height, step, width, step, *cut.shape[2:]).mean(axis=(1, 3)))

    both = maps.mask & (truth("mask") == 1)
    normal = truth("normal")[both]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mean = normal.mean(axis=0) / np.linalg.norm(normal.mean(axis=0))
    angle, plane = (np.degrees(np.arccos(np.clip((normal * n).sum(-1), -1, 1))) for n in (maps.normal[both], mean))
    rmse = [
        float(np.sqrt(np.mean((truth(name)[both] - getattr(maps, name)[both]) ** 2)))
        for name in ("diffuse", "roughness", "specular")
    ]
    means = float(angle.mean()), float(np.median(angle)), float(maps.confidence[both].mean()), float(plane.mean())
    return [*means, *rmse]


if __name__ == "__main__":
    main()
