"""Benchmark of the stages `cues` and `infer`: errors of all maps on the path-traced scenes of `make_mitsuba.py`.

    python tests/benchmarks/bench_mitsuba.py FOLDER [--model ONNX] [--analytic] [--clean] [--rough]

Light, interreflection and shadows are Mitsuba's. The camera is that of `polcap evaluate`: 20 ke⁻, read noise 5 e⁻,
three exposures, gain errors of 0.3 %, angle errors of 0.5°; --clean has none of these. With --rough, and for rough
materials always, S1 and S2 are scaled to the microfacet law of each pixel's roughness. `turned` is the share of the
object [%] in connected regions of at least 0.1 % of it with normals turned by 180° about the view ray: regions where
the tangential part of the normal points away from the true one, at true zenith angles above 20°.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_captures import facet_share
from scipy import ndimage

from polcap.formats import onnx
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.stage_values import SurfaceMaps
from polcap.stages import cues, infer
from polcap.training.camera_errors import CameraErrors, photograph
from polcap.training.evaluation_protocol import Case, stokes_image, white
from polcap.training.map_errors import Judge
from tests.experiments import arguments, head, networks, row

ROWS = (
    "normal_mean", "normal_median", "normal_mean_core", "diffuse", "specular", "roughness", "depth", "rendering",
    "turned",
)  # fmt: skip


def main() -> None:
    options = arguments(__doc__, "folder", "--analytic", "--clean", "--rough", model=Path)
    estimators = {name: networks(name, options.model)[0] for name in ("network", "analytic")[: 1 + options.analytic]}
    print(head("scene", "material", "estimator", *ROWS))
    table: dict[tuple[str, str], list[list[float]]] = {}
    for number, file in enumerate(sorted(options.folder.glob("*.npz"))):
        case, material = read(file, options.clean, options.rough, seed=number)
        judge = Judge(case)
        for name, network in estimators.items():
            maps = infer.estimate(case.cues, network, onnx.run, infer.InferSettings())
            errors = judge.score(maps) | {"turned": turned_share(maps, case.truth)}
            figures = [errors.get(key, np.nan) for key in ROWS]
            for group in (material, "all"):
                table.setdefault((group, name), []).append(figures)
            print(row(case.name, material, name, *figures), flush=True)
    for (material, name), rows in table.items():
        print(row(f"mean of {len(rows)}", material, name, *np.nanmean(rows, axis=0)))


def turned_share(maps: SurfaceMaps, truth: SurfaceMaps) -> float:
    """Percent of the object in regions with normals turned by about 180° around the view ray."""
    both = maps.mask & truth.mask
    opposite = (maps.normal[..., :2] * truth.normal[..., :2]).sum(axis=-1) < 0
    turned = both & opposite & (truth.normal[..., 2] < np.cos(np.radians(20)))
    regions, _ = ndimage.label(turned)
    area = np.bincount(regions.ravel())[1:]
    return float(100 * area[area >= 0.001 * both.sum()].sum() / both.sum())


def read(file: Path, clean: bool, rough: bool, seed: int) -> tuple[Case, str]:
    """One scene as the camera measures it with its truth, and the name of its material."""
    with np.load(file) as stored:
        made = {name: stored[name] for name in stored.files}
    mask, about = made["mask"], json.loads(str(made["about"]))
    view = _view(made)
    rays = frames.rays(view, *mask.shape)
    scene, diffuse, inside, v = (
        torch.from_numpy(np.asarray(value, order="C"))[None]
        for value in (scene_light(made, rough), made["diffuse"], mask, rays)
    )
    one = torch.ones(1)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        errors = CameraErrors.none(1, one.device) if clean else CameraErrors.stated(1, one.device)
        seen = photograph(scene[0][:, None], diffuse, inside, v, torch.from_numpy(np.flatnonzero(mask)), errors)
    measured = cues.compute(stokes_image(seen, mask, view), white())
    depth = np.where(mask, (made["depth"] - made["middle"]) / made["unit"], 0).astype(np.float32)
    truth = SurfaceMaps(
        made["normal"], made["diffuse"], made["specular"], made["roughness"], depth,
        np.zeros(mask.shape, np.float32), mask, view, "truth",
    )  # fmt: skip
    return Case(file.stem, measured, measured, measured, truth, depth), about["material"]


def scene_light(made: dict[str, Any], rough: bool = False) -> Floats:
    """Stokes parameters (3, H, W, 3) of a scene; under the microfacet law if asked, and for rough materials always."""
    light = made["stokes"].copy()
    if rough or json.loads(str(made["about"]))["rough_law"]:
        rays = frames.rays(_view(made), *made["mask"].shape)
        light[1:] *= facet_share(made["normal"], made["roughness"] ** 2, made["ior"], rays)[..., None]
    return np.asarray(light)


def _view(made: dict[str, Any]) -> View:
    return View(float(made["focal"]), (float(made["center"][0]), float(made["center"][1])), 1.0)


if __name__ == "__main__":
    main()
