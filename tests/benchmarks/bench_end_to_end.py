"""What the camera costs: captures of test meshes through the whole path, beside the same scenes as noise-free cues.

    python tests/benchmarks/bench_end_to_end.py FOLDER [--data $POLCAP_DATA] [--captures 12] [--width 768]
                                                [--estimator analytic] [--model ONNX]

20 ke⁻, read noise 5 e⁻, 1 % flash jitter, 0.5° angle error, nudges up to 1.5 px and 0.05°, one bounce of
interreflection. Captures are kept in FOLDER and used again. Prints a Markdown row per capture: mean normal error
over the pixels that both know, and the loss, which is to stay below 1.5° on average.
"""

import argparse
import os
from pathlib import Path
from typing import get_args

import cv2
import msgspec
import numpy as np

from polcap.config import Config
from polcap.formats import onnx
from polcap.formats.capture import reader as captures
from polcap.images import ColorCalibration, Floats, Network, StokesImage
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.stages import cues, infer
from polcap.synth import scenes
from polcap.synth import shooting as synthetic
from polcap.synth.forward_camera import Sensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, default=os.environ.get("POLCAP_DATA"))
    parser.add_argument("--captures", type=int, default=12)
    parser.add_argument("--width", type=int, default=768)
    parser.add_argument("--estimator", choices=("network", "analytic"))
    parser.add_argument("--model", type=Path)
    options = parser.parse_args()
    network = models.load_network(options.estimator, options.model, "cpu", 2)
    print("| capture | through the camera | noise-free cues | loss |\n| --- | --- | --- | --- |")
    rows = []
    for number in range(options.captures):
        place = make(options.folder, options.data, number, options.width)
        rows.append(measure(place, network))
        print(f"| {place.name} |", " | ".join(f"{value:.2f}" for value in rows[-1]), "|", flush=True)
    print("| mean |", " | ".join(f"{value:.2f}" for value in np.mean(rows, axis=0)), "|")


def make(folder: Path, data: Path, number: int, width: int) -> Path:
    """Capture `number`, made if it is not there."""
    meshes = sorted((data / "meshes" / "test").glob("*.npz"))
    textures = sorted(p.parent for p in (data / "materials" / "test").glob("*/albedo.jpg"))
    mesh, kinds = meshes[number % len(meshes)], get_args(scenes.Kind)
    place = folder / f"{number:02d}_{mesh.stem}"
    if not place.exists():
        scene = scenes.with_model(scenes.random_scene(number, kinds[number % len(kinds)]), mesh, number)
        if number % 2:
            scene = scenes.with_textures(scene, textures[number // 2 % len(textures)])
        shoot = synthetic.Shoot(
            seed=number, width=width, height=width * 3 // 4, sensor=Sensor(full_well=20000, read_noise=5)
        )
        synthetic.write(place, msgspec.structs.replace(scene, interreflection=True), shoot)
    return place


def measure(place: Path, network: Network | None) -> list[float]:
    """Mean normal error [degrees] through the path and from noise-free cues, and their difference."""
    supplied = UserInput(network=network, mask_network=models.load_mask_network(2))
    found = path(captures.read(place, None), supplied, Config(), MemoryCache(until="infer"))
    x0, y0, x1, y1 = found.object_.crop
    measured, maps = found.stokes, found.maps
    with np.load(place / "truth.npz") as truth:
        normal, stokes, mask = (_binned(truth[k].astype(np.float32)) for k in ("normal", "S", "mask"))
    crop = np.s_[..., y0:y1, x0:x1, :]
    normal, stokes, inside = normal[crop], stokes[crop], mask[..., None][crop][..., 0] == 1
    clean = StokesImage(
        stokes,
        np.full((6, *stokes.shape[1:]), 1e-14, np.float32),
        0 * measured.quality,
        inside,
        measured.view,
        None,
    )
    white = ColorCalibration(np.eye(3, dtype=np.float32), "profile")
    ideal = infer.estimate(cues.compute(clean, white), network, onnx.run, Config().infer)
    both = inside & maps.mask
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    errors = [_angle(normal, one.normal)[both].mean() for one in (maps, ideal)]
    return [float(errors[0]), float(errors[1]), float(errors[0] - errors[1])]


def _binned(image: Floats) -> Floats:
    """2×2 RAW pixels in one, (..., H, W[, 3])."""
    if image.ndim == 4:
        return np.stack([_binned(part) for part in image])
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def _angle(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1))))


if __name__ == "__main__":
    main()
