"""Benchmark of flat and sharp-edged things: thirty simulated captures by kind, RAW to maps, against their truth.

    python tests/benchmarks/bench_flat.py FOLDER [--model ONNX] [--captures 30] [--width 640]

Plates with relief, coins, sheets, boxes, books and cans in turn, each at five tilts; the first of five pairs of laws is
smooth. Shapes are those of `training/flat_shapes.py` with seeds that training does not use. FOLDER gets the captures,
which are made once. Prints a Markdown row per capture and the means by kind. `plane` is the error of a guess: a plane
with the true mean normal. `warned`: gates that are not quiet.
"""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.optics import frames
from polcap.optics.mesh_tracer import Triangles, centred
from polcap.optics.resize import block_means
from polcap.results import Results
from polcap.synth import shooting
from polcap.synth.distance_fields import Model
from polcap.synth.render import Scene
from polcap.synth.scenes import random_scene
from polcap.training import flat_shapes
from tests.experiments import arguments, head, judge, networks, raw_pixels, rms, row

ROWS = ("normal mean", "median", "expected", "plane", "diffuse", "roughness", "F0")
SOLID, PLANE = (25.0, 35.0, 45.0, 55.0, 40.0), (0.0, 5.0, 16.0, 30.0, 50.0)  # deg, tilts
KINDS = {
    "plate": (flat_shapes._slab, PLANE), "coin": (flat_shapes._coin, PLANE), "sheet": (flat_shapes._sheet, PLANE),
    "box": (flat_shapes._box, SOLID), "book": (flat_shapes._book, SOLID), "can": (flat_shapes._can, SOLID),
}  # fmt: skip
RADIUS = 0.07  # m, of the smallest sphere around the object
SEED = 90210  # of shapes and poses


def main() -> None:
    options = arguments(__doc__, "folder", model=Path, captures=30, width=640)
    using = networks(model=options.model)
    print(head("capture", "law", *ROWS, "warned"))
    table: dict[str, list[list[float]]] = {}
    for number in range(options.captures):
        kind = list(KINDS)[number % len(KINDS)]
        folder = options.folder / f"{number:02d}_{kind}"
        scene = draw(number, kind, options.folder)
        if not folder.exists():
            shoot = shooting.Shoot(seed=number, width=options.width, height=options.width * 3 // 4)
            shooting.write(folder, scene, shoot)
        found, lines = judge(folder, using)
        warned = ", ".join(f"{line.name} {line.state}" for line in lines if line.state in ("warn", "fail"))
        figures = errors(found, folder)
        for name in (kind, str(scene.law), "all"):
            table.setdefault(name, []).append(figures)
        print(row(folder.name, scene.law, *figures, warned), flush=True)
    for name, rows in table.items():
        print(row(f"mean of {len(rows)}", name, *np.mean(rows, axis=0), ""))


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
    step, cut = raw_pixels(maps)
    with np.load(folder / "truth.npz") as file:
        names = ("normal", "mask", "diffuse", "roughness", "specular")
        truth = {name: block_means(file[name][cut].astype(np.float32), step) for name in names}
    both = maps.mask & (truth["mask"] == 1)
    normal = frames.unit(truth["normal"][both])
    angle, plane = (frames.angle_deg(normal, n) for n in (maps.normal[both], frames.unit(normal.mean(axis=0))))
    rmse = [rms((truth[name] - getattr(maps, name))[both]) for name in names[2:]]
    means = float(angle.mean()), float(np.median(angle)), float(maps.confidence[both].mean()), float(plane.mean())
    return [*means, *rmse]


if __name__ == "__main__":
    main()
