"""Cache of traced views of training meshes, without materials: geometry, flash visibility, rays between surface points.

Views are square, fp16, with one array file per quantity, which is read as a memory map. The seed determines all views.
"""

import json
import shutil
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.errors import InputError, StorageError
from polcap.formats import atomic, scene_files, text_file
from polcap.image_values import Bools, Floats, View
from polcap.optics.mesh_tracer import GBuffer, Tracer, Triangles, scatter, smooth
from polcap.optics.outline import disc_radius
from polcap.training import bounced_light, flat_shapes, light_transport, random_shapes
from polcap.training.progress import Report, silent

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
Rotate = Callable[[np.random.Generator], Floats]  # draws a rotation (3, 3) from object to camera
_PROGRESS = "tracing.json"  # of an interrupted cache
_REPORT_S, _SAVE_S = 10.0, 30.0  # between two lines of progress, between two records of it
_TRIES = 200  # random sides before a mesh is rejected
_MAX_OFFSET = 0.1  # of the distance, between lens and a random flash


@dataclass(frozen=True)
class ViewsRecipe:
    """Settings of a cache of traced views."""

    views: int  # of each mesh
    procedural: int  # random shapes
    size: int  # px
    seed: int
    per_shape: int = 6  # views of each random or flat shape
    flat: int = 0  # flat and sharp-edged shapes, as many views each
    flash: tuple[float, float] | None = None  # right of the lens and above it, in object distances; None: at random


def open_cache(
    folder: Path, meshes: list[Path], recipe: ViewsRecipe, report: Report = silent
) -> dict[str, NDArray[Any]]:
    """Open a cache of traced views; trace the views first if the folder has no complete cache.

    Returns the arrays of ARRAYS (N, S, S, ·) as memory maps, and camera (N, 16): focal length, center x, y [px]; middle
    depth [m]; depth unit [m]; rotation from object to camera (9); flash to the right of the lens and above it [middle
    depths]. index.json is written last, so that an interrupted cache is recognized, and continued.

    Raises InputError: the folder holds views of other meshes or another recipe.
    """
    index = folder / "index.json"
    inputs = json.dumps(asdict(recipe) | {"meshes": [mesh.stem for mesh in meshes]})
    if not index.exists():
        _build_cache(folder, meshes, recipe, inputs, report)
        atomic.write(index, inputs)
        (folder / _PROGRESS).unlink()
    elif index.read_text() != inputs:
        raise InputError(
            f"{folder} holds views of other meshes or of another preset; remove it, or choose another --out"
        )
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ARRAYS}
    return arrays | {"camera": np.load(folder / "camera.npy")}


def cache_bytes(views: int, size: int) -> int:
    """Size of a cache of traced views on disk."""
    of_one = sum((size // by) ** 2 * channels * np.dtype(kind).itemsize for by, channels, kind in ARRAYS.values())
    return views * (of_one + 16 * 4)  # with the camera: 16 numbers of 4 bytes


def _build_cache(folder: Path, meshes: list[Path], recipe: ViewsRecipe, inputs: str, report: Report) -> None:
    """Trace all views of a recipe and write their arrays; an interrupted cache continues after its last shape.

    `inputs` is the JSON text of recipe and meshes, by which an interrupted cache is recognized.

    Raises StorageError: the disk has too little space.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shapes, size = len(meshes) + recipe.procedural + recipe.flat, recipe.size
    total = _first_view(shapes, meshes, recipe)
    begun = _traced_meshes(folder, inputs)  # number of shapes
    first = _first_view(begun, meshes, recipe)
    gigabytes = cache_bytes(total, size) / 1e9
    free = shutil.disk_usage(folder).free / 1e9
    if not begun and gigabytes > free:
        raise StorageError(
            f"{folder}: {total} traced views need {gigabytes:.1f} GB, {free:.1f} GB are free; "
            "take fewer with --views, --procedural and --flat, or another --out"
        )
    there = f"; {first} of them are there" if first else ""
    of_shapes = f"{len(meshes)} meshes, {recipe.procedural} random shapes and {recipe.flat} flat ones"
    report(f"tracing {total} views of {of_shapes}, {gigabytes:.2g} GB in {folder}{there}")
    made = {**ARRAYS, "camera": (size, 16, np.float32)}  # a row per view, as in `open_cache`
    arrays: dict[str, NDArray[Any]] = {}
    for name, (by, channels, kind) in made.items():
        shape = (total, channels) if name == "camera" else (total, size // by, size // by, channels)
        mode: Literal["r+", "w+"] = "r+" if begun else "w+"
        arrays[name] = np.lib.format.open_memmap(folder / f"{name}.npy", mode, kind, shape)
    start = reported = saved = time.monotonic()
    for number in range(begun, shapes):
        views = _trace_shape(number, meshes, recipe)
        for index, view in enumerate(views, _first_view(number, meshes, recipe)):
            _store(arrays, index, *view)
            now = time.monotonic()
            if index == first or now - reported > _REPORT_S:
                reported = now
                minutes = (now - start) / (index + 1 - first) * (total - index - 1) / 60
                report(f"{index + 1} of {total} views, {minutes:.0f} min left")
        if time.monotonic() - saved > _SAVE_S or number == shapes - 1:
            saved = time.monotonic()
            for array in arrays.values():
                assert isinstance(array, np.memmap)
                array.flush()
            atomic.write(folder / _PROGRESS, json.dumps({"inputs": inputs, "meshes": number + 1}))


def _first_view(number: int, meshes: list[Path], recipe: ViewsRecipe) -> int:
    """Index of the first view of a mesh or random shape."""
    return min(number, len(meshes)) * recipe.views + max(number - len(meshes), 0) * recipe.per_shape


def _traced_meshes(folder: Path, inputs: str) -> int:
    """Number of meshes and random shapes that an interrupted cache of the same inputs holds."""
    try:
        known = text_file.read_json(folder / _PROGRESS)
        complete = all((folder / f"{name}.npy").exists() for name in (*ARRAYS, "camera"))
        return int(known["meshes"]) if complete and known["inputs"] == inputs else 0
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def _store(
    arrays: Mapping[str, NDArray[Any]], index: int, buffer: GBuffer, pose: light_transport.LitPose, lit: Bools,
    met: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Write one view into the arrays of a cache."""
    inside = buffer.mask
    middle, unit = depth_unit(inside, buffer.depth, buffer.view.focal)
    depth = np.where(inside, (buffer.depth - middle) / unit, 0.0)
    view = {
        "normal": buffer.normal, "depth": depth, "position": buffer.position, "mask": inside, "lit": lit, "met": met,
    }  # fmt: skip
    for name, value in view.items():
        arrays[name][index] = value.reshape(arrays[name][index].shape)
    camera = [buffer.view.focal, *buffer.view.center, middle, unit, *pose.rotation.reshape(-1)]
    arrays["camera"][index] = [*camera, *pose.flash[:2] / middle]


def training_meshes(data: Path) -> list[Path]:
    """Mesh files for training, sorted by name."""
    return sorted(path for path in (data / "meshes" / "train").glob("*.npz") if path.stem not in WITHHELD)


def test_meshes(data: Path) -> list[Path]:
    """Mesh files for tests, sorted by name. Raises InputError: there are none."""
    folder = data / "meshes" / "test"
    if not (files := sorted(folder.glob("*.npz"))):
        remedy = f"`python -m polcap.training.import_data SOURCE {data}` converts OBJ, GLB and PLY"
        raise InputError(f"{folder} holds no mesh; {remedy}")
    return files


def read_mesh(path: Path) -> Triangles:
    """Read a training mesh and add shading normals."""
    return smooth(*scene_files.read_mesh(path))


def fill(mask: Bools, values: Floats) -> Floats:
    """Image (H, W, ·) with values (M, ·) at the pixels of the mask, 0 elsewhere."""
    return scatter(values, np.flatnonzero(mask), mask.shape)


def depth_unit(mask: Bools, depth: Floats, focal: float) -> tuple[float, float]:
    """Mean depth of the object, and the unit of the network's relative depth.

    The unit is the radius of the disc with the area of the mask, at the mean depth: √(area/π) · depth / focal. For a
    photograph, the mask gives the unit up to the unknown distance.
    """
    middle = float(depth[mask].mean(dtype=np.float64))
    return middle, disc_radius(mask) * middle / focal


def _trace_shape(
    number: int, meshes: list[Path], recipe: ViewsRecipe
) -> Iterator[tuple[GBuffer, light_transport.LitPose, Bools, NDArray[np.uint16]]]:
    """Trace the views of a mesh or random shape: G-buffer, pose of mesh and flash, result of `trace_visibility`."""
    if number < len(meshes):
        path = meshes[number]
        rng = np.random.default_rng([recipe.seed, zlib.crc32(path.stem.encode())])
        name, mesh, count, rotate = str(path), read_mesh(path), recipe.views, random_shapes.rotation
    else:
        shape, count = number - len(meshes), recipe.per_shape
        kind = random_shapes if shape < recipe.procedural else flat_shapes
        rng = np.random.default_rng([recipe.seed, 7, shape])
        name, mesh, rotate = f"random shape {shape}", kind.compose(rng), kind.rotation
    tracer = Tracer(mesh)
    for _ in range(count):
        buffer, rotation, translation = trace_random_view(name, tracer, recipe.size, rng, rotate)
        drawn = random_flash(rng)  # in any case, so that `recipe.flash` changes no view
        offset = drawn if recipe.flash is None else recipe.flash
        middle, _ = depth_unit(buffer.mask, buffer.depth, buffer.view.focal)
        pose = light_transport.LitPose(rotation, translation, middle * np.array([*offset, 0.0]), middle**2)
        yield buffer, pose, *bounced_light.trace_visibility(tracer, buffer, pose, rng)


def random_flash(rng: np.random.Generator) -> tuple[float, float]:
    """Position of a random flash to the right of the lens and above it, in object distances: at most 0.1 away."""
    azimuth, offset = rng.uniform(0, 2 * np.pi), rng.uniform(0, _MAX_OFFSET)
    return offset * np.cos(azimuth), offset * np.sin(azimuth)


def trace_random_view(
    name: str, tracer: Tracer, size: int, rng: np.random.Generator, rotate: Rotate = random_shapes.rotation
) -> tuple[GBuffer, Floats, Floats]:
    """Trace the mesh from a random side, drawn by `rotate`: G-buffer, rotation (3, 3) and translation (3,).

    Raises InputError: the mesh is too thin: it covers too little of the picture from all sides.
    """
    for _ in range(_TRIES):
        rotation, translation, view = random_pose(tracer.mesh, size, rng, rotate)
        buffer = tracer.trace(rotation, translation, view, size, size)
        if buffer.mask.mean() >= LEAST_SHARE:
            return buffer, rotation, translation
    raise InputError(
        f"{name} covers less than {LEAST_SHARE:.0%} of the picture from each of {_TRIES} sides; give a less thin mesh"
    )


def random_pose(
    mesh: Triangles, size: int, rng: np.random.Generator, rotate: Rotate = random_shapes.rotation
) -> tuple[Floats, Floats, View]:
    """Random pose of a mesh and crop of the picture: field of view 5–35°, up to 12° off axis, 60–95 % filled."""
    while True:
        rotation = rotate(rng)
        turned = mesh.vertices @ rotation.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        fill = rng.uniform(0.6, 0.95)
        angle = fill * 2 * np.tan(np.radians(rng.uniform(5, 35)) / 2)  # of the object's longer image side
        distance = max(high[0] - low[0], high[1] - low[1]) / angle
        slope, azimuth = np.tan(np.radians(rng.uniform(0, 12))), rng.uniform(0, 2 * np.pi)
        centre = distance * np.array([slope * np.cos(azimuth), slope * np.sin(azimuth), -1.0])
        translation = centre - (low + high) / 2
        if -(high[2] + translation[2]) > distance / 2:  # no point is nearer to the lens than half the distance
            return rotation, translation, _frame_crop(turned + translation, fill, size, rng)


def _frame_crop(place: Floats, fill: float, size: int, rng: np.random.Generator) -> View:
    """Square crop; projected points (V, 3) of the camera frame fill the share `fill` of its side, at a random place."""
    x, y = place[:, 0] / -place[:, 2], place[:, 1] / place[:, 2]
    focal = fill * size / max(np.ptp(x), np.ptp(y))
    slack = (1 - fill) * size / 2
    cx, cy = ((size - 1) / 2 - focal * (a.min() + a.max()) / 2 + rng.uniform(-slack, slack) for a in (x, y))
    return View(focal=float(focal), center=(float(cx), float(cy)), scale=1.0)
