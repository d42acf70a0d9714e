"""Benchmark of export time: a whole export against encoding the same files alone.

python tests/benchmarks/bench_export.py FOLDER [--side 2048]     (usd-core for `archive`)

Makes a result folder with maps of SIDE² pixels, a ball with two paints, and exports every preset.
`export` builds mesh and textures from the maps, too. `alone` encodes the pictures of the preset, each once, and its
layered EXR. CPU seconds of all threads together and of the child that reads files, its start included; the least of
three rounds.
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np

from polcap.config import Config
from polcap.formats import sandbox
from polcap.formats.export import exr_layers, gltf, texture_set
from polcap.formats.export.encoders import TextureEncoder
from polcap.formats.export.presets import PRESETS, ExportPreset
from polcap.formats.maps import maps_folder
from polcap.image_values import Floats, View
from polcap.mesh_values import Asset, ReliefMesh
from polcap.optics import frames
from polcap.pipeline import asset_export, detail_levels
from polcap.pipeline.export_request import ExportRequest
from polcap.stage_values import Cues, StokesImage, SurfaceMaps
from tests import surfaces
from tests.experiments import arguments, processor_s


def main(folder: Path, side: int) -> None:
    about = result(folder, side)
    source = detail_levels.read(folder / "maps", Config())
    print(f"{'preset':10}{'alone s':>10}{'export s':>10}{'ratio':>8}{'MB':>8}")
    for name in PRESETS:
        built = detail_levels.levels(source, ExportRequest(preset=name))[0].asset
        encode, whole = (min(times) for times in zip(*(both(folder, about, built, name) for _ in range(3))))
        size = sum(file.stat().st_size for file in (folder / "asset" / name).iterdir()) / 1e6
        print(f"{name:10}{encode:10.2f}{whole:10.2f}{whole / encode:8.2f}{size:8.1f}", flush=True)


def both(folder: Path, about: dict[str, Any], built: Asset, name: str) -> tuple[float, float]:
    """Seconds of the encoding alone, and of an export from the maps."""

    def export() -> None:
        asset_export.write(folder, about, ExportRequest(preset=name), detail_levels.read(folder / "maps", Config()))

    encode = seconds(lambda: alone(folder, built, PRESETS[name]))
    shutil.rmtree(folder / "asset", ignore_errors=True)
    return encode, seconds(export)


def seconds(work: Callable[[], object]) -> float:
    """CPU seconds of this process and of the children that it starts to read files."""
    sandbox.end_idle()
    start = processor_s()
    work()
    sandbox.end_idle()
    return processor_s() - start


def alone(folder: Path, built: Asset, preset: ExportPreset) -> None:
    """Encode what the preset holds in pictures, and nothing else."""
    encoder = TextureEncoder()
    for texture in gltf.textures(built).values():
        encoder(texture, preset.images)
    loose = texture_set.LOOSE.values() if "obj" in preset.formats else ()
    for make in (*(texture_set.TEXTURES[name] for name in preset.textures.values()), *loose):
        encoder(make(built), "png")
    if "exr" in preset.formats:
        exr_layers.write(folder / "alone.exr", folder / "maps", exr_layers.LINEAR_REC709, {})


def result(folder: Path, side: int) -> dict[str, Any]:
    """Write maps/ of a ball, side² pixels; returns what its report.json would hold."""
    scale = side / surfaces.WIDTH
    view = View(surfaces.VIEW.focal * scale, (surfaces.VIEW.center[0] * scale, side / 2), 1.0)
    ball = surfaces.maps()
    grown = {name: enlarged(getattr(ball, name), side) for name in ("normal", "diffuse", "specular", "roughness")}
    noise = np.random.default_rng(0).normal(scale=0.01, size=(side, side)).astype(np.float32)
    maps = replace(
        ball,
        normal=frames.unit(grown["normal"]),
        diffuse=np.clip(grown["diffuse"] + noise[..., None], 0, 1),
        specular=np.clip(0.04 + noise[..., None] / 4, 0, 1).repeat(3, axis=-1),
        roughness=np.clip(grown["roughness"] / 2 + noise, 0, 1),
        confidence=np.full((side, side), 3.0, np.float32),
        mask=enlarged(ball.mask.astype(np.float32), side) > 0.5,
        view=view,
    )
    small = surfaces.mesh(ball)
    mesh = replace(small, depth=enlarged(np.nan_to_num(small.depth, nan=surfaces.DISTANCE), side))
    write(folder, maps, mesh, noise)
    about = {"polcap": "0", "capture": {"name": "ball", "camera": "", "shots": []}, "model": None, "keys": {}}
    return about | {"verdict": "pass", "gates": [], "settings": msgspec.to_builtins(Config())}


def enlarged(values: Floats, side: int) -> Floats:
    return np.asarray(cv2.resize(np.asarray(values, np.float32), (side, side), interpolation=cv2.INTER_LINEAR))


def write(folder: Path, maps: SurfaceMaps, mesh: ReliefMesh, noise: Floats) -> None:
    size = noise.shape
    s0 = maps.diffuse + noise[..., None]
    quality = np.zeros(size, np.uint8)
    stokes = StokesImage(
        np.stack([s0] * 3) / 3, np.zeros((6, *size, 3), np.float32), quality, maps.mask, maps.view, residual=None
    )
    cues = Cues(
        radiance=maps.diffuse, ratio=np.stack([noise, noise]), ratio_sigma=np.full(size, 0.01, np.float32),
        dolp=np.abs(noise), normalized_stokes=maps.normal[..., :2].transpose(2, 0, 1), diffuse_color=maps.diffuse,
        rays=maps.normal, mask=maps.mask, quality=quality, view=maps.view,
    )  # fmt: skip
    results: Any = SimpleNamespace(maps=maps, mesh=mesh, stokes=stokes, cues=cues, keys={})
    maps_folder.write(folder / "maps", results)


if __name__ == "__main__":
    options = arguments(__doc__, "folder", side=2048)
    main(options.folder.resolve(), options.side)
