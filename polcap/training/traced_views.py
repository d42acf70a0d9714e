"""Cache of traced views of training meshes, without materials.

Geometry, flash visibility, and rays between surface points.

Views are square, fp16, one array per quantity, readable as memory maps. All follows from the seed.
"""

import json
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import InputError
from polcap.formats import atomic, scene_files
from polcap.images import Floats, GBuffer, View
from polcap.synth.mesh_tracer import Tracer, Triangles, scatter, smooth
from polcap.training import bounced_light, light_transport, random_shapes

ARRAYS = {  # step in pixels, channels, type
    "normal": (1, 3, np.float16), "depth": (1, 1, np.float16), "position": (1, 3, np.float16),
    "mask": (1, 1, np.bool_), "lit": (1, 1, np.bool_), "met": (bounced_light.COARSE, bounced_light.RAYS, np.uint16),
}  # fmt: skip
LEAST_SHARE = 0.06  # of the picture; views of smaller objects, as of a sheet seen from its edge, are rejected
WITHHELD = frozenset((  # meshes that training must not use: new objects for evaluation (calib/models/polcap.md)
    "bjs_molten_dagger", "blub", "chen_red_marker", "chess_queen", "gso_bia_cordon_bleu_white_porcelain_utensil_",
    "gso_dino_5", "gso_razer_kraken_pro_headset_full_size_black", "gso_room_essentials_salad_plate_turquoise",
    "gso_sonny_school_bus", "gso_sperry_topsider", "gso_sterilite_caddy_blue_sky_17_58_x_12_58_x", "gz_ball_valve",
    "gz_trash_can", "poly_sugar_cup", "statue_maria", "ycb_dice", "ycb_fork", "ycb_nine_hole_peg_test", "ycb_orange",
    "ycb_tomato_soup_can",
))  # fmt: skip
_TRIES = 200  # random sides before a mesh is rejected
_MAX_OFFSET = 0.1  # of the distance, between lens and a random flash


@dataclass(frozen=True)
class ViewsRecipe:
    """Settings of a cache of traced views."""

    views: int  # of each mesh
    procedural: int  # random shapes
    size: int  # px
    seed: int
    per_shape: int = 6  # views of each random shape
    flash: tuple[float, float] | None = None  # right of the lens and above it, in object distances; None: at random


def open_cache(folder: Path, meshes: list[Path], recipe: ViewsRecipe) -> dict[str, NDArray[Any]]:
    """Open a cache of traced views; trace the views first if the folder has no complete cache.

    Returns the arrays of ARRAYS (N, S, S, ·) as memory maps, and camera (N, 16): focal length, center x, y [px]; middle
    depth [m]; depth unit [m]; rotation from object to camera (9); flash to the right of the lens and above it [middle
    depths]. index.json is written last, so that an interrupted cache is recognized.

    Raises
    ------
    InputError
        The folder holds views of other meshes or another recipe.
    """
    index = folder / "index.json"
    inputs = json.dumps(asdict(recipe) | {"meshes": [mesh.stem for mesh in meshes]})
    if not index.exists():
        _build_cache(folder, meshes, recipe)
        with atomic.path(index) as temporary:
            temporary.write_text(inputs)
    elif index.read_text() != inputs:
        raise InputError(
            f"{folder} holds views of other meshes or of another preset; remove it, or choose another --out"
        )
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ARRAYS}
    return arrays | {"camera": np.load(folder / "camera.npy")}


def _build_cache(folder: Path, meshes: list[Path], recipe: ViewsRecipe) -> None:
    """Trace all views of a recipe and write their arrays."""
    folder.mkdir(parents=True, exist_ok=True)
    size = recipe.size
    total = recipe.views * len(meshes) + recipe.per_shape * recipe.procedural
    out = {
        name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", kind, (total, size // by, size // by, channels))
        for name, (by, channels, kind) in ARRAYS.items()
    }
    cameras = np.zeros((total, 16), dtype=np.float32)
    for index, (buffer, pose, lit, met) in enumerate(_trace_all(meshes, recipe)):
        inside = buffer.mask
        middle, unit = depth_unit(inside, buffer.depth, buffer.view.focal)
        depth = np.where(inside, (buffer.depth - middle) / unit, 0.0)
        view = {
            "normal": buffer.normal,
            "depth": depth,
            "position": buffer.position,
            "mask": inside,
            "lit": lit,
            "met": met,
        }
        for name, value in view.items():
            out[name][index] = value.reshape(out[name][index].shape)
        offset = pose.flash[:2] / middle
        cameras[index] = [buffer.view.focal, *buffer.view.center, middle, unit, *pose.rotation.reshape(-1), *offset]
    for array in out.values():
        array.flush()
    np.save(folder / "camera.npy", cameras)


def training_meshes(data: Path) -> list[Path]:
    """Mesh files for training, sorted by name."""
    return sorted(path for path in (data / "meshes" / "train").glob("*.npz") if path.stem not in WITHHELD)


def read_mesh(path: Path) -> Triangles:
    """Read a mesh file and add shading normals."""
    return smooth(*scene_files.read_mesh(path))


def fill(mask: NDArray[np.bool_], values: Floats) -> Floats:
    """Image (H, W, ·) with values (M, ·) at the pixels of the mask, 0 elsewhere."""
    return scatter(values, np.flatnonzero(mask), mask.shape)


def depth_unit(mask: NDArray[np.bool_], depth: Floats, focal: float) -> tuple[float, float]:
    """Mean depth of the object, and the unit of the network's relative depth.

    The unit is the radius of the disc with the area of the mask, at the mean depth: √(area/π) · depth / focal. For a
    photograph, the mask gives the unit up to the unknown distance.
    """
    middle = float(depth[mask].mean(dtype=np.float64))
    return middle, float(np.sqrt(mask.sum() / np.pi) * middle / focal)


def _trace_all(
    meshes: list[Path], recipe: ViewsRecipe
) -> Iterator[tuple[GBuffer, light_transport.Pose, NDArray[np.bool_], NDArray[np.uint16]]]:
    """Trace all views of a recipe: G-buffer, pose of mesh and flash, and the result of `trace_visibility` for each."""
    for number in range(len(meshes) + recipe.procedural):
        if number < len(meshes):
            path = meshes[number]
            rng = np.random.default_rng([recipe.seed, zlib.crc32(path.stem.encode())])
            name, mesh, count = str(path), read_mesh(path), recipe.views
        else:
            shape = number - len(meshes)
            rng = np.random.default_rng([recipe.seed, 7, shape])
            name, mesh, count = f"random shape {shape}", random_shapes.compose(rng), recipe.per_shape
        tracer = Tracer(mesh)
        for _ in range(count):
            buffer, rotation, translation = trace_random_view(name, tracer, recipe.size, rng)
            way, off = rng.uniform(0, 2 * np.pi), rng.uniform(0, _MAX_OFFSET)
            offset = (off * np.cos(way), off * np.sin(way)) if recipe.flash is None else recipe.flash
            middle = float(buffer.depth[buffer.mask].mean(dtype=np.float64))
            pose = light_transport.Pose(rotation, translation, middle * np.array([*offset, 0.0]), middle**2)
            yield buffer, pose, *bounced_light.trace_visibility(tracer, buffer, pose, rng)


def trace_random_view(name: str, tracer: Tracer, size: int, rng: np.random.Generator) -> tuple[GBuffer, Floats, Floats]:
    """Trace the mesh from a random side: G-buffer, rotation (3, 3) and translation (3,).

    Raises
    ------
    InputError
        The mesh is too thin: it covers too little of the picture from all sides.
    """
    for _ in range(_TRIES):
        rotation, translation, view = random_pose(tracer.mesh, size, rng)
        buffer = tracer.trace(rotation, translation, view, size, size)
        if buffer.mask.mean() >= LEAST_SHARE:
            return buffer, rotation, translation
    raise InputError(
        f"{name} covers less than {LEAST_SHARE:.0%} of the picture from each of {_TRIES} sides; give a less thin mesh"
    )


def random_pose(mesh: Triangles, size: int, rng: np.random.Generator) -> tuple[Floats, Floats, View]:
    """Random pose of a mesh and crop of the picture: field of view 5–35°, up to 12° off axis, 60–95 % filled."""
    while True:
        rotation = random_shapes.rotation(rng)
        turned = mesh.vertices @ rotation.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        fill = rng.uniform(0.6, 0.95)
        angle = fill * 2 * np.tan(np.radians(rng.uniform(5, 35)) / 2)  # of the object's longer image side
        distance = max(high[0] - low[0], high[1] - low[1]) / angle
        off, way = np.tan(np.radians(rng.uniform(0, 12))), rng.uniform(0, 2 * np.pi)
        centre = distance * np.array([off * np.cos(way), off * np.sin(way), -1.0])
        translation = centre - (low + high) / 2
        if -(high[2] + translation[2]) > distance / 2:  # not too near the lens
            return rotation, translation, _frame_crop(turned + translation, fill, size, rng)


def _frame_crop(place: Floats, fill: float, size: int, rng: np.random.Generator) -> View:
    """Square crop in which projected points (V, 3) of the camera frame fill the share `fill` of its side."""
    x, y = place[:, 0] / -place[:, 2], place[:, 1] / place[:, 2]
    focal = fill * size / max(np.ptp(x), np.ptp(y))
    slack = (1 - fill) * size / 2
    cx, cy = ((size - 1) / 2 - focal * (a.min() + a.max()) / 2 + rng.uniform(-slack, slack) for a in (x, y))
    return View(focal=float(focal), center=(float(cx), float(cy)), scale=1.0)
