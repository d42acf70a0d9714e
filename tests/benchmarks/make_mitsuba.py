"""Path-trace test scenes with Mitsuba 3, with interreflection: noise-free Stokes parameters and the true maps.

    python tests/benchmarks/make_mitsuba.py FOLDER [--data $POLCAP_DATA] [--scenes 12] [--size 256] [--depth 5]
        [--meshes test|train|withheld] [--material mixed|kinds|NAME]

The meshes are used in turn, posed as `polcap evaluate` poses them, under a flash 5 % of the distance above the lens.
A mixed object has two kinds of plastic with three grades each: the albedo is a texture set or solid noise, each kind
has one index, each grade one k_s and one roughness. The other materials are in MATERIALS; `kinds` uses them in turn.
Dark gloss lies on dark cloth: a floor, a wall and sometimes a chart that it reflects.

The command writes one .npz per scene and skips existing ones. A scene is rendered until the Monte-Carlo error of its
DoLP, from two halves with independent seeds, is below 0.1 %, or 64 passes are done.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plastic
import trimesh

from polcap.formats import atomic, scene_files
from polcap.image_values import Bools, Floats, View
from polcap.optics import frames, fresnel
from polcap.optics.mesh_tracer import Triangles
from polcap.synth import scene_materials
from polcap.training import traced_views
from tests.experiments import arguments, data

FACES = 100_000  # at least, after subdivision: each has one colour
TEXELS = 1024  # side of the bitmap that holds the faces' colours
PASS, LEAST, MOST = 16, 2, 64  # samples per pixel of a pass, passes
GOAL = 1e-3  # DoLP, 1σ: 95 % of the lit pixels are to lie within twice that


def main() -> None:
    options = arguments(
        __doc__, "folder", data=Path, scenes=12, size=256, depth=5, meshes=("test", "train", "withheld"),
        material=("mixed", "kinds", *MATERIALS),
    )  # fmt: skip
    source = options.data or data()
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    mi.set_log_level(mi.LogLevel.Error)
    meshes = {
        "train": traced_views.training_meshes(source),
        "test": sorted((source / "meshes" / "test").glob("*.npz")),
        "withheld": [source / "meshes" / "train" / f"{name}.npz" for name in sorted(traced_views.WITHHELD)],
    }[options.meshes]
    sets = sorted(p.parent for p in (source / "materials" / "test").glob("*/albedo.jpg"))
    for index in range(options.scenes):
        file_of_mesh = meshes[index % len(meshes)]
        file = options.folder / f"{index:02d}_{file_of_mesh.stem}.npz"
        if file.exists():
            continue
        random = np.random.default_rng([2026, index])
        texture = sets[index // 2 % len(sets)] if index % 2 else None
        name = list(MATERIALS)[index % len(MATERIALS)] if options.material == "kinds" else options.material
        began = time.monotonic()
        mesh = traced_views.read_mesh(file_of_mesh)
        pose = traced_views.random_pose(mesh, options.size, random)
        made, about = shoot(mi, mesh, pose, name, texture, options.size, options.depth, random)
        with atomic.path(file) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, about=np.array(json.dumps(about)), **made)
        print(file.name, json.dumps(about), f"{time.monotonic() - began:.0f} s", flush=True)


@dataclass(frozen=True)
class SceneMaterial:
    """One material of a whole object; ranges from which each scene draws."""

    albedo: tuple[float, float]
    roughness: tuple[float, float]
    f0: tuple[float, float] = (0.035, 0.05)
    saturation: float = 0.2  # 1σ of the natural logarithm of one channel
    textured: bool = False  # albedo is a texture set, scaled to the range
    rough_law: bool = False  # diffuse light leaves through microfacets; bench_mitsuba scales S1 and S2
    cloth: bool = False  # dark cloth below and behind the object


MATERIALS = {
    "matte": SceneMaterial((0.2, 0.7), (0.65, 0.85)),
    "satin": SceneMaterial((0.15, 0.6), (0.4, 0.55)),
    "glossy": SceneMaterial((0.15, 0.6), (0.15, 0.3)),
    "white glaze": SceneMaterial((0.65, 0.85), (0.1, 0.25), saturation=0.03),
    "colored gloss": SceneMaterial((0.1, 0.5), (0.2, 0.4), saturation=0.8),
    "dark gloss": SceneMaterial((0.01, 0.06), (0.05, 0.3), (0.036, 0.044), cloth=True),
    "dark satin": SceneMaterial((0.03, 0.08), (0.35, 0.5), cloth=True),
    "printed": SceneMaterial((0.1, 0.6), (0.3, 0.5), textured=True),
    "rough": SceneMaterial((0.15, 0.6), (0.5, 0.7), rough_law=True),
    "rough stone": SceneMaterial((0.15, 0.5), (0.6, 0.8), textured=True, rough_law=True),
}


def shoot(
    mi: Any, mesh: Triangles, pose: tuple[Floats, Floats, View], name: str, texture: Path | None, size: int, depth: int,
    random: np.random.Generator, light: list[float] | None = None,
) -> tuple[dict[str, Floats], dict[str, Any]]:  # fmt: skip
    """Stokes parameters (3, H, W, 3) in the frame of each ray, truth maps, camera; and how it was made.

    `pose`: rotation and translation, object to camera, and the camera. `texture`: a folder, or None for solid noise.
    `depth`: longest path; 2 is direct light only. `light` (3,) m: the flash in the camera frame; None: above the lens
    by 5 % of the distance.
    """
    rotation, translation, view = pose
    corner, normal = subdivided(mesh)
    material = MATERIALS.get(name)
    coat = plain(corner, material, texture, random) if material else dressed(corner, texture, random)
    if not trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight:
        corner, normal = facing(corner, normal, -translation @ rotation)
    far = float(-translation[2] - np.mean(corner @ rotation[2]))
    light = light or [0.0, 0.05 * far, 0.0]
    parts = [
        {
            "position": corner[which] @ rotation.T + translation,
            "normal": normal[which] @ rotation.T,
            **{name: coat[name][which] for name in "rgb"},
            **grade,
        }
        for number, grade in enumerate(coat["grades"])
        if (which := coat["grade"] == number).any()
    ]
    truth = seen(mi, parts, view, size)
    mask = truth["mask"]
    middle, unit = traced_views.depth_unit(mask, truth["depth"], view.focal)
    halves = np.zeros((2, 3, size, size, 3))
    passes, error = 0, [np.inf, np.inf]
    around = (
        cloth(mi, np.concatenate([part["position"] for part in parts]), random) if material and material.cloth else {}
    )
    scenes = [scene(mi, parts, channel, light, np.pi * middle**2, view, size, depth, around) for channel in "rgb"]
    while passes < LEAST or (error[1] > 2 * GOAL and passes < MOST):
        for k, one in enumerate(scenes):
            halves[passes % 2, ..., k] += shot(mi, one, view, seed=3 * passes + k)
        passes += 1
        if passes % 2 == 0:
            error = dolp_error(halves, mask)
    about = {
        "material": name, "rough_law": bool(material and material.rough_law),
        "texture": texture.name if texture else "noise", "grades": coat["grades"], "light": light, "depth": depth,
        "samples": passes * PASS, "dolp_error": error,
    }  # fmt: skip
    camera = {"focal": view.focal, "center": view.center, "middle": middle, "unit": unit}
    stokes = (halves.sum(axis=0) / passes).astype(np.float32)
    return {"stokes": stokes, **truth, **{k: np.array(v) for k, v in camera.items()}}, about


def subdivided(mesh: Triangles) -> tuple[Floats, Floats]:
    """Corners (F, 3, 3) and their normals, each triangle cut in four until there are enough."""
    corner: Floats = mesh.vertices[mesh.faces].astype(np.float64)
    normal: Floats = mesh.corner_normals.astype(np.float64)
    while len(corner) < FACES:
        corner, normal = (_quartered(value) for value in (corner, normal))
    return corner, normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def facing(corner: Floats, normal: Floats, camera: Floats) -> tuple[Floats, Floats]:
    """Turn triangles that show the camera their back: `pplastic` has none, and `twosided` mirrors its Stokes frame."""
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    away = np.einsum("fi,fi->f", across, camera - corner[:, 0]) < 0
    corner, normal = corner.copy(), normal.copy()
    corner[away], normal[away] = corner[away, ::-1], -normal[away, ::-1]
    return corner, normal


def _quartered(value: Floats) -> Floats:
    a, b, c = value[:, 0], value[:, 1], value[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def dressed(corner: Floats, texture: Path | None, random: np.random.Generator) -> dict[str, Any]:
    """Albedo r, g, b of every face (F,) and the number of its grade; k_s, α and n of the six grades."""
    middle = corner.mean(axis=1)
    noise = [scene_materials.solid_noise(middle * scale, int(random.integers(1 << 30))) for scale in (3.0, 12.0, 25.0)]
    second = noise[0] > random.uniform(-0.6, 0.6)
    base = random.uniform(0.08, 0.85, 3) * random.uniform(0.5, 1)
    if texture is None:
        other = np.clip(base * random.uniform(0.4, 1.6, 3), 0.03, 0.9)
        albedo = base + (other - base) / (1 + np.exp(-3 * noise[1][:, None]))
    else:
        albedo = projected(scene_files.read_textures(texture)[:3], corner, random.uniform(1, 2.5))
    if random.random() < 0.5:
        paint = random.uniform(0.08, 0.8, 3)
        albedo = np.where(second[:, None], paint * (1 + 0.15 * noise[2][:, None]), albedo)
    level = np.digitize(noise[1], (-0.5, 0.5))
    grades = []
    for rough in random.uniform((0.2, 0.4), (0.5, 0.8)):
        ior = float(random.uniform(1.4, 1.6))
        f0 = random.choice([0.042 * np.exp(0.2 * random.normal()), random.uniform(0.02, 0.2)])
        follow, gloss = random.uniform(-0.3, 0.3, 2)
        for step in (-1, 0, 1):
            strength = float(f0 * (1 + step * follow) / fresnel.normal_reflectance(ior))
            grades.append({"strength": strength, "alpha": float((rough * (1 + step * gloss)) ** 2), "ior": ior})
    maps = {name: np.clip(albedo[:, k], 0.02, 0.9) for k, name in enumerate("rgb")}
    return {**maps, "grade": 3 * second + level, "grades": grades}


def plain(corner: Floats, of: SceneMaterial, texture: Path | None, random: np.random.Generator) -> dict[str, Any]:
    """One material for all faces, as `dressed` returns it."""
    level = random.uniform(*of.albedo)
    albedo = level * np.exp(random.normal(0, of.saturation, 3)) * np.ones((len(corner), 1))
    if of.textured and texture is not None:
        picture = projected(scene_files.read_textures(texture)[:3], corner, random.uniform(1, 2.5))
        albedo = level * picture / picture.mean()
    elif of.textured:
        noise = scene_materials.solid_noise(corner.mean(axis=1) * 12, int(random.integers(1 << 30)))
        albedo = albedo * np.exp(0.5 * noise[:, None])
    ior, f0 = float(random.uniform(1.45, 1.55)), float(random.uniform(*of.f0))
    alpha = float(random.uniform(*of.roughness) ** 2)
    grade = {"strength": float(f0 / fresnel.normal_reflectance(ior)), "alpha": alpha, "ior": ior}
    maps = {name: np.clip(albedo[:, k], 0.01, 0.9) for k, name in enumerate("rgb")}
    return {**maps, "grade": np.zeros(len(corner), int), "grades": [grade]}


def cloth(mi: Any, corners: Floats, random: np.random.Generator) -> dict[str, Any]:
    """A floor, a wall and in two of five scenes a chart, about corners (..., 3) that face a camera at the origin."""
    points = corners.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, _ = (float(one) for one in (low + high) / 2)
    side, depth = float((high - low).max()), float(low[2] + high[2]) / 2
    dark = {"type": "diffuse", "reflectance": float(random.uniform(0.02, 0.08))}
    place, tilt = mi.ScalarTransform4f(), float(random.uniform(0, 8))
    wall = float(low[2]) - float(random.uniform(0.2, 1)) * side
    found = {"wall": (place.translate([x, y, wall]).scale(6 * side), dark)}
    if low[1] < -0.3 * side:  # else it would hide the object
        floor = place.translate([x, float(low[1]) - 0.01 * side, depth]).rotate([1, 0, 0], tilt - 90)
        found["floor"] = (floor.scale(4 * side), dark)
    if random.random() < 0.4 and high[0] > -0.1 * side:
        chart = place.translate([float(high[0]) + float(random.uniform(0.3, 0.8)) * side, y, depth])
        grey = {"type": "diffuse", "reflectance": 0.2}
        found["chart"] = (chart.rotate([0, 1, 0], -90).scale(0.35 * side), grey)
    return {name: {"type": "rectangle", "to_world": at, "bsdf": body} for name, (at, body) in found.items()}


def projected(picture: Floats, corner: Floats, scale: float) -> Floats:
    """A picture (3, T, T), mirrored at its sides, on faces (F, 3, 3) along the nearest axis; (F, 3)."""
    axis = np.abs(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])).argmax(axis=1)
    middle = corner.mean(axis=1) * scale
    u, v = (np.take_along_axis(middle, ((axis + k) % 3)[:, None], 1)[:, 0] for k in (1, 2))
    column, row = (np.rint(np.abs((x + 1) % 4 - 2) * (picture.shape[-1] - 1) / 2).astype(int) for x in (u, v))
    return np.asarray(picture[:, row, column].T)


def square_crop(mask: Bools, view: View, margin: int) -> tuple[View, int, tuple[slice, slice]]:
    """The camera, the side [px] and the rows and columns of a square around a mask (H, W) with a margin [px]."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    top, left = int(rows[0]) - margin, int(columns[0]) - margin
    size = max(int(rows[-1]) - top, int(columns[-1]) - left) + 1 + margin
    crop = View(view.focal, (view.center[0] - left, view.center[1] - top), 1.0)
    return crop, size, np.s_[top : top + size, left : left + size]


def scene(
    mi: Any, parts: list[Any], channel: str, light: list[float], power: float, view: View, size: int, depth: int,
    around: dict[str, Any],
) -> Any:  # fmt: skip
    """What Mitsuba renders of one colour channel, with other shapes around."""
    sensor = plastic.camera(mi, view, size, "independent", PASS)
    sensor["film"]["pixel_format"] = "luminance"
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "stokes", "nested": {"type": "path", "max_depth": depth}},
            "sensor": sensor,
            "light": {"type": "point", "position": light, "intensity": power},
            **{f"part{k}": body(mi, part, channel) for k, part in enumerate(parts)},
            **around,
        }
    )


def body(mi: Any, part: dict[str, Any], channel: str) -> Any:
    """One region's triangles: a texel for each face, and its material as attributes for the truth."""
    count = len(part["position"])
    settings = mi.Properties()
    look = plastic.plastic(part["alpha"], part["ior"], texels(mi, part[channel]), part["strength"])
    settings["bsdf"] = mi.load_dict(look)
    mesh = mi.Mesh("part", 3 * count, count, has_vertex_normals=True, has_vertex_texcoords=True, props=settings)
    for name in ("r", "g", "b", "strength", "alpha", "ior"):
        mesh.add_attribute(f"face_{name}", 1, np.broadcast_to(part[name], count).astype(np.float32))
    row, column = np.divmod(np.arange(count), TEXELS)
    at = (np.stack([column, row], axis=1) + 0.5) / TEXELS  # v runs down the rows
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = part["position"].astype(np.float32).ravel()
    parameters["vertex_normals"] = part["normal"].astype(np.float32).ravel()
    parameters["vertex_texcoords"] = np.repeat(at, 3, axis=0).astype(np.float32).ravel()
    parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
    parameters.update()
    return mesh


def texels(mi: Any, value: Floats) -> dict[str, Any]:
    """One number per face, row by row."""
    image = np.zeros(TEXELS * TEXELS, np.float32)
    image[: len(value)] = value
    bitmap = mi.Bitmap(image.reshape(TEXELS, TEXELS, 1))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}


def shot(mi: Any, one: Any, view: View, seed: int) -> Floats:
    """One pass of one channel: (3, H, W) in the frame of each ray."""
    return plastic.in_ray_frame(np.array(mi.render(one, seed=seed))[..., -12::3], view)


def seen(mi: Any, parts: list[Any], view: View, size: int) -> dict[str, Any]:
    """Truth at the pixel centres: normal (camera frame, facing it), depth, mask and the material."""
    y, x = np.mgrid[:size, :size].astype(np.float64)
    v = frames.rays_at(view, x, y).reshape(-1, 3)
    found = mi.load_dict({"type": "scene", **{f"part{k}": body(mi, p, "r") for k, p in enumerate(parts)}})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(np.ascontiguousarray(-v.T, np.float32)))
    hit = found.ray_intersect(ray)
    mask = np.array(hit.is_valid())
    value = {
        name: np.where(mask, np.array(hit.shape.eval_attribute_1(f"face_{name}", hit, hit.is_valid())), 0)
        for name in ("r", "g", "b", "strength", "alpha", "ior")
    }
    normal = np.array(hit.sh_frame.n).T
    normal = np.where(mask[:, None], normal * np.sign((normal * v).sum(-1, keepdims=True)), 0)
    f0 = value["strength"] * fresnel.normal_reflectance(np.maximum(value["ior"], 1))
    flat = {
        "normal": normal,
        "depth": np.where(mask, np.array(hit.t) * v[:, 2], np.nan),
        "mask": mask,
        "diffuse": np.stack([value[c] for c in "rgb"], axis=-1),
        "specular": np.repeat(f0[:, None], 3, axis=1),
        "roughness": np.sqrt(value["alpha"]),
        "ior": value["ior"],
    }
    shaped = {name: image.reshape(size, size, *image.shape[1:]) for name, image in flat.items()}
    return {name: image if image.dtype == bool else image.astype(np.float32) for name, image in shaped.items()}


def dolp_error(halves: Floats, mask: Any) -> list[float]:
    """What 68 % and 95 % of the lit pixels' DoLP is within, both halves together; (2, 3, H, W, 3).

    Lit is what has 2 % of the light of the object's bright parts: below, a camera sees its own noise.
    Quantiles, because a few pixels that see a mirrored spark of light are off by far more.
    """
    total = halves.sum(axis=-1)
    s0 = total[:, 0].min(axis=0)
    lit = mask & (s0 > 0.02 * np.percentile(s0[mask], 90))
    dolp = np.hypot(total[:, 1], total[:, 2])[:, lit] / total[:, 0, lit]
    return [float(x) for x in np.percentile(np.abs(dolp[0] - dolp[1]) / 2, (68.3, 95.4))]


if __name__ == "__main__":
    main()
