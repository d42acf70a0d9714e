"""The cache of traced views: normals, depth and positions of training meshes, before any material.

Views are square, fp16, one array per quantity, readable as memory maps. Everything is fixed by the seed.
"""

import json
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.errors import InputError
from polcap.formats import mesh as mesh_files
from polcap.images import Floats, GBuffer, View
from polcap.synth.mesh import Tracer, Triangles, smooth
from polcap.training import shapes

ARRAYS = {"normal": (3, np.float16), "depth": (1, np.float16), "position": (3, np.float16), "mask": (1, np.bool_)}


def build(
    folder: Path, meshes: list[Path], *, views: int, procedural: int, per_shape: int = 8, size: int = 192, seed: int = 1
) -> int:
    """Trace `views` views of each mesh and `per_shape` of each of `procedural` random shapes; returns how many.

    Written so that an interrupted build leaves no cache that looks whole: index.json comes last.
    """
    folder.mkdir(parents=True, exist_ok=True)
    total = views * len(meshes) + per_shape * procedural
    out = {
        name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", kind, (total, size, size, channels))
        for name, (channels, kind) in ARRAYS.items()
    }
    cameras = np.zeros((total, 14), dtype=np.float32)
    for index, (buffer, rotation, middle, unit) in enumerate(_traced(meshes, views, procedural, per_shape, size, seed)):
        inside = buffer.mask
        out["normal"][index] = buffer.normal
        out["depth"][index, ..., 0] = np.where(inside, (buffer.depth - middle) / unit, 0.0)
        out["position"][index] = buffer.position
        out["mask"][index, ..., 0] = inside
        cameras[index] = [buffer.view.focal, *buffer.view.center, middle, unit, *rotation.reshape(-1)]
    for array in out.values():
        array.flush()
    np.save(folder / "camera.npy", cameras)
    text = {"views": total, "size": size, "seed": seed, "meshes": [m.stem for m in meshes], "procedural": procedural}
    (folder / "index.json").write_text(json.dumps(text))
    return total


def load(folder: Path, *, mapped: bool = True) -> dict[str, NDArray]:  # type: ignore[type-arg]
    """The cache, as memory maps or in memory: normal, depth, position, mask (N, S, S, ·) and camera (N, 14).

    camera: focal, centre x, y [px]; middle depth [m]; depth unit [m]; object → camera rotation, 9.
    """
    if not (folder / "index.json").exists():
        raise InputError(f"{folder} holds no complete G-buffer cache; build it with `polcap train`")
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r" if mapped else None) for name in ARRAYS}
    return arrays | {"camera": np.load(folder / "camera.npy")}


def read_mesh(path: Path) -> Triangles:
    """A mesh file with shading normals."""
    return smooth(*mesh_files.read(path))


def depth_unit(mask: NDArray[np.bool_], depth: Floats, focal: float) -> tuple[float, float]:
    """Middle depth of the object and the length that relative depth counts in.

    The unit is the radius of the disc that covers as many pixels as the mask, at the middle depth:
    √(area/π) · depth / focal. Both can be had from a photograph's mask but for the distance itself.
    """
    middle = float(depth[mask].mean(dtype=np.float64))
    return middle, float(np.sqrt(mask.sum() / np.pi) * middle / focal)


def _traced(
    meshes: list[Path], views: int, procedural: int, per_shape: int, size: int, seed: int
) -> Iterator[tuple[GBuffer, Floats, float, float]]:
    for path in meshes:
        rng = np.random.default_rng([seed, zlib.crc32(path.stem.encode())])
        yield from _look(read_mesh(path), views, size, rng)
    for shape in range(procedural):
        rng = np.random.default_rng([seed, 7, shape])
        yield from _look(shapes.compose(rng), per_shape, size, rng)


def _look(
    mesh: Triangles, count: int, size: int, rng: np.random.Generator
) -> Iterator[tuple[GBuffer, Floats, float, float]]:
    tracer = Tracer(mesh)
    while count:
        rotation, translation, view = pose(mesh, size, rng)
        buffer = tracer.trace(rotation, translation, view, size, size)
        if buffer.mask.mean() < 0.06:  # a sheet seen from its edge teaches nothing
            continue
        count -= 1
        yield buffer, rotation, *depth_unit(buffer.mask, buffer.depth, view.focal)


def pose(mesh: Triangles, size: int, rng: np.random.Generator) -> tuple[Floats, Floats, View]:
    """Random turn, crop's field of view 5–35°, up to 12° off axis, object filling 60–95 % of the crop."""
    while True:
        rotation = shapes.rotation(rng)
        turned = mesh.vertices @ rotation.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        fill = rng.uniform(0.6, 0.95)
        angle = fill * 2 * np.tan(np.radians(rng.uniform(5, 35)) / 2)  # of the object's longer image side
        distance = max(high[0] - low[0], high[1] - low[1]) / angle
        off, way = np.tan(np.radians(rng.uniform(0, 12))), rng.uniform(0, 2 * np.pi)
        centre = distance * np.array([off * np.cos(way), off * np.sin(way), -1.0])
        translation = centre - (low + high) / 2
        if -(high[2] + translation[2]) > distance / 2:  # not with the nose in the lens
            return rotation, translation, _framed(turned + translation, fill, size, rng)


def _framed(seen: Floats, fill: float, size: int, rng: np.random.Generator) -> View:
    """The crop in which points (V, 3) of the camera frame fill that share of its side."""
    x, y = seen[:, 0] / -seen[:, 2], seen[:, 1] / seen[:, 2]
    focal = fill * size / max(np.ptp(x), np.ptp(y))
    slack = (1 - fill) * size / 2
    cx, cy = ((size - 1) / 2 - focal * (a.min() + a.max()) / 2 + rng.uniform(-slack, slack) for a in (x, y))
    return View(focal=float(focal), center=(float(cx), float(cy)), scale=1.0)
