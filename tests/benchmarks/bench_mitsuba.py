"""Scenes of `make_mitsuba.py` through the cues and the inference stage: errors of every map, scene by scene.

    python tests/benchmarks/bench_mitsuba.py FOLDER [--model ONNX] [--clean] [--rough]

The camera is the evaluation's: 20 ke⁻, 5 e⁻, three exposures ×4 apart, 0.3 % of gain, 0.5° of angle; --clean has none
of it; --rough leaves of S1 and S2 what facets of each pixel's roughness leave. Light, interreflection and shadows are
Mitsuba's. Prints a Markdown row per scene and estimator.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from bench_captures import kept

from polcap.formats import onnx
from polcap.images import ColorCalibration, SurfaceMaps, View
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stages import cues, infer
from polcap.training.camera_errors import CameraErrors, photograph
from polcap.training.evaluation_protocol import Case, stokes_image
from polcap.training.map_errors import Judge

ROWS = ("normal_mean", "normal_median", "normal_mean_core", "diffuse", "specular", "roughness", "depth", "rendering")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--clean", action="store_true")
    parser.add_argument("--rough", action="store_true")
    options = parser.parse_args()
    networks = {"network": models.load_network("network", options.model, "cpu", 2), "analytic": None}
    print("| scene | estimator |", " | ".join(ROWS), "|\n| --- | --- |", " | ".join("---" for _ in ROWS), "|")
    table: dict[str, list[list[float]]] = {name: [] for name in networks}
    for number, file in enumerate(sorted(options.folder.glob("*.npz"))):
        case = read(file, options.clean, options.rough, seed=number)
        judge = Judge(case)
        for name, network in networks.items():
            found = judge.score(infer.estimate(case.cues, network, onnx.run, infer.InferSettings()))
            row = [found.get(key, np.nan) for key in ROWS]
            table[name].append(row)
            print(f"| {case.name} | {name} |", " | ".join(f"{value:.3g}" for value in row), "|", flush=True)
    for name, rows in table.items():
        print(f"| mean of {len(rows)} | {name} |", " | ".join(f"{value:.3g}" for value in np.mean(rows, axis=0)), "|")


def read(file: Path, clean: bool, rough: bool, seed: int) -> Case:
    """One scene as the camera measures it, and its truth."""
    with np.load(file) as stored:
        made = {name: stored[name] for name in stored.files}
    mask = made["mask"]
    view = View(float(made["focal"]), (float(made["center"][0]), float(made["center"][1])), 1.0)
    rays = frames.rays(view, *mask.shape)
    if rough:
        made["stokes"][1:] *= kept(made["normal"], made["roughness"] ** 2, made["ior"], rays)[..., None]
    scene, diffuse, given, v = (
        torch.from_numpy(np.asarray(value, order="C"))[None] for value in (made["stokes"], made["diffuse"], mask, rays)
    )
    one = torch.ones(1)
    at = np.flatnonzero(mask)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        errors = CameraErrors.none(1, one.device) if clean else CameraErrors.stated(1, one.device)
        seen = photograph(scene[0][:, None], diffuse, given, v, torch.from_numpy(at), errors)
    white = ColorCalibration(np.eye(3, dtype=np.float32), "profile")
    measured = cues.compute(stokes_image(seen, at, mask, view), white)
    depth = np.where(mask, (made["depth"] - made["middle"]) / made["unit"], 0).astype(np.float32)
    truth = SurfaceMaps(
        normal=made["normal"],
        diffuse=made["diffuse"],
        specular=made["specular"],
        roughness=made["roughness"],
        depth_prior=depth,
        confidence=np.zeros(mask.shape, np.float32),
        mask=mask,
        view=view,
        estimator="truth",
    )
    texture = json.loads(str(made["about"]))["texture"]
    return Case(f"{file.stem}, {texture}", measured, measured, measured, truth, depth)


if __name__ == "__main__":
    main()
