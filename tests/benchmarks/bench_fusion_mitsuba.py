"""Benchmark of `polcap fuse` on RAW photographs of objects that Mitsuba path-traces, under the rough polarization law.

    POLCAP_DATA=FOLDER python tests/benchmarks/bench_fusion_mitsuba.py OUT [--views 12] [--only NAME…]

Sessions as of `polcap synth --views`, with board and chart, but the object's pixels are traced by `make_mitsuba.py`,
with interreflection: material "rough" (one albedo, roughness and F0). OUT has scenes, sessions and results, so that a
stopped run continues. Prints for each object the mean errors of single views and of the fused maps, and the mean
distance of the seen truth from the mesh, % of the object's size.
"""

import json
import subprocess
import sys
import zlib
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bench_fused_asset
import msgspec
import numpy as np
from bench_mitsuba import scene_light
from make_mitsuba import MATERIALS, plain, shoot, square_crop

from polcap.formats import atomic
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.synth import all_around, forward_camera, render, trace
from polcap.synth.all_around import AroundShoot
from polcap.synth.distance_fields import Model
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from tests.experiments import arguments, data, head, row

OBJECTS = ("spot", "demosthenes")
SHOOT = AroundShoot(width=960, height=720, samples=1, exposures=1, nudge_px=0, nudge_deg=0)  # all shots, same pixels
SEED, DEPTH = 2026, 5  # of the material; longest path
MARGIN = 4  # px around the object
SIDE = 4  # rays per pixel side for the share that the object covers


def main() -> None:
    options = arguments(__doc__, "out", views=12, only=list(OBJECTS))
    print(head("object", "views", "normals °", "albedo", "F0", "roughness", "mesh %"))
    for name in options.only:
        folder = options.out / f"{name}_{options.views}"
        if not folder.exists():
            write(folder, name, options.views, options.out / "scenes")
        subprocess.run([sys.executable, "-m", "polcap", "fuse", str(folder)], check=True, stdout=subprocess.DEVNULL)
        errors = bench_fused_asset.errors(folder)
        cells = [f"{one:.3g} → {both:.3g}" for one, both in zip(errors.single.mean(axis=0), errors.fused.mean(axis=0))]
        print(row(name, options.views, *cells, 100 * errors.distance), flush=True)


def write(folder: Path, name: str, views: int, traced: Path) -> None:
    """Write the RAW files of a session and its truth; `traced` caches Mitsuba's scenes."""
    mesh = data() / "meshes/test" / f"{name}.npz"
    scene = Scene(Model(str(mesh), SHOOT.radius_m), Coat((material(),)), law="rough")
    traced.mkdir(parents=True, exist_ok=True)
    with patch.object(render, "stokes", partial(path_traced, traced, render.stokes)):
        all_around.write(folder, scene, SHOOT, views)


def material() -> Material:
    """The material that `make_mitsuba.shoot` draws with this seed, as one of polcap's renderer."""
    drawn = plain(np.zeros((1, 3, 3)), MATERIALS["rough"], None, np.random.default_rng(SEED))
    color, grade = (float(drawn["r"][0]), float(drawn["g"][0]), float(drawn["b"][0])), drawn["grades"][0]
    rough = grade["alpha"] ** 0.5
    return Material(color, color, "plain", roughness=(rough, rough), specular=grade["strength"], ior=grade["ior"])


def path_traced(traced: Path, stokes: Any, scene: Scene, view: View, x: Floats, y: Floats, *others: Any) -> Floats:
    """Stokes parameters (3, H, W, 3) of `render.stokes`, with the object's pixels by Mitsuba."""
    out: Floats = stokes(scene, view, x, y, *others)
    mask = render.gbuffer(scene, view, *x.shape).mask
    crop, size, inside = square_crop(mask, view, MARGIN)
    file = traced / f"{zlib.crc32(msgspec.json.encode(scene)):08x}.npz"
    if not file.exists():
        render_scene(file, scene, crop, size)
    with np.load(file) as stored:
        made = {name: stored[name] for name in stored.files}
    at = mask[inside]
    squared = np.sum((np.array(scene.light) - np.array(scene.position)) ** 2)  # m², where polcap's white has S0 = 1
    light = scene_light(made) * (squared / made["middle"] ** 2) / covered(scene, crop, size)[..., None]
    out[:, *inside][:, at] = light[:, at]
    return out


def render_scene(file: Path, scene: Scene, view: View, size: int) -> None:
    """Path-trace a view; all views draw the same material."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    pose = scene.turn.as_matrix(), np.array(scene.position), view
    random, flash = np.random.default_rng(SEED), list(scene.light)
    made, about = shoot(mi, all_around.surface(scene), pose, "rough", None, size, DEPTH, random, flash)
    with atomic.path(file) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, about=np.array(json.dumps(about)), **made)


def covered(scene: Scene, view: View, size: int) -> Floats:
    """Share (H, W) of each pixel that the object covers; Mitsuba's pixels are means over their areas."""
    out = np.zeros(size * size)
    for x, y in forward_camera.pixel_samples(size, size, SIDE):
        rays = frames.rays_at(view, x, y).reshape(-1, 3)
        out[trace.trace(scene.shape, scene.position, scene.turn, rays).index] += 1 / SIDE**2
    return np.maximum(out, 1 / SIDE**2).reshape(size, size)


if __name__ == "__main__":
    main()
