"""Benchmark of exports: the same asset rendered by Cycles, three.js and polcap under three lights.

python tests/benchmarks/bench_look.py FOLDER     (needs $POLCAP_BPY, a Chromium, `npm ci` in tests/gltf, usd-core)

Prints, per light and renderer, how far its picture is from another's, of the 99th percentile of that
picture: median and 95th percentile over the pixels that face camera and light within 45°, within 60°, and over
all others. A ball with two paints, varying roughness and F0, and rippled normals; suns, no shadows.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.formats.export import encoders, gltf, texture_set, usd
from polcap.image_values import Floats
from polcap.mesh_values import Asset
from polcap.optics import frames, shade
from polcap.stage_values import SurfaceMaps
from tests import surfaces
from tests.blender import session
from tests.render import browser

LIGHTS = {"frontal": (0.0, 0.0, 1.0), "oblique right": (0.7, 0.2, 0.7), "oblique above": (-0.3, 0.8, 0.5)}
SAMPLES = 64
PAIRS = (("cycles usd", "cycles glb"), ("three.js", "cycles glb"), ("cycles glb", "polcap"), ("three.js", "polcap"))


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    maps = varied()
    mesh = surfaces.mesh(surfaces.maps())
    asset = surfaces.built(maps, mesh)
    write(folder, asset)
    height, width = maps.mask.shape
    camera = {
        "focal": maps.view.focal,
        "center": maps.view.center,
        "size": [width, height],
        "position": [float(-x) for x in gltf.center(mesh.vertices)],
    }
    files = [folder / "ball.glb", folder / "ball.usdc"]
    blender = session.ask(folder, files, camera=camera, lights=list(LIGHTS.values()), samples=SAMPLES)
    job = browser.Job("ball", files[0], mesh, maps.view, tuple(LIGHTS.values()))
    web = browser.render(folder, [job])["ball"]
    print(f"{'light':15}{'pictures':26}{'within 45°':>18}{'within 60°':>18}{'others':>18}   (median, 95 %)")
    for k, (light, to_light) in enumerate(LIGHTS.items()):
        seen = {
            "cycles glb": blender[0][f"light {k}"],
            "cycles usd": blender[1][f"light {k}"],
            "three.js": web[k],
            "polcap": own(maps, np.array(to_light)),
        }
        inside = inner(maps, *seen.values())
        towards = np.minimum(cosine(maps, to_light), cosine(maps, (0, 0, 1)))
        places = [inside & where for where in (towards > np.sqrt(0.5), towards > 0.5, towards <= 0.5)]
        for one, other in PAIRS:
            scale = np.percentile(seen[other][inside], 99)
            off = np.abs(seen[one] - seen[other]).max(axis=-1) / scale
            errors = [" %, ".join(f"{100 * np.percentile(off[where], q):.1f}" for q in (50, 95)) for where in places]
            print(f"{light:15}{f'{one} : {other}':26}" + "".join(f"{text + ' %':>18}" for text in errors))
        np.savez(folder / f"{light}.npz", allow_pickle=False, **seen)


def varied() -> SurfaceMaps:
    column, row = np.meshgrid(np.arange(surfaces.WIDTH), np.arange(surfaces.HEIGHT))
    specular = (0.025 + 0.035 * column / surfaces.WIDTH).astype(np.float32)
    return replace(
        surfaces.maps(ripple=0.05),
        roughness=(0.4 + 0.35 * row / surfaces.HEIGHT).astype(np.float32),
        specular=np.repeat(specular[..., None], 3, axis=-1),
    )


def write(folder: Path, asset: Asset) -> None:
    files: dict[texture_set.Key, str] = {key: f"ball_{key}.png" for key in texture_set.LOOSE}
    for key, file in files.items():
        (folder / file).write_bytes(encoders.encode(texture_set.LOOSE[key](asset), "png"))
    (folder / "ball.glb").write_bytes(gltf.encode(asset, "ball"))
    usd.write(folder / "ball.usdc", asset, "ball", files, {})


def own(maps: SurfaceMaps, to_light: Floats) -> Floats:
    """S0 of the maps (H, W, 3) by polcap's renderer, the sun as bright as the others'."""
    rays = frames.rays(maps.view, *maps.mask.shape)
    light = np.broadcast_to(to_light / np.linalg.norm(to_light), rays.shape)
    index = np.full(maps.mask.shape, 1.5)
    stokes = shade.stokes(
        frames.to_ray_frame(maps.normal, rays), maps.diffuse, maps.specular, maps.roughness, index,
        frames.to_ray_frame(light, rays), np.ones(maps.mask.shape),
    )  # fmt: skip
    return np.asarray(stokes[0])


def cosine(maps: SurfaceMaps, direction: tuple[float, float, float]) -> Floats:
    return np.asarray(maps.normal @ (np.array(direction) / np.linalg.norm(direction)))


def inner(maps: SurfaceMaps, *pictures: Floats) -> NDArray[np.bool_]:
    """Pixels of the object a few pixels from its rim and from the seam of the two paints."""
    mask: NDArray[np.bool_] = maps.mask.copy()
    red = maps.diffuse[..., 0] > maps.diffuse[..., 1]
    for axis in (0, 1):
        for step in range(-3, 4):
            mask &= np.roll(maps.mask, step, axis) & (np.roll(red, step, axis) == red)
    for picture in pictures:
        mask &= np.isfinite(picture).all(axis=-1) & (picture.max(axis=-1) < 1)
    return mask


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
