"""Error of every map on test meshes under held-out materials: the network beside its baselines.

What is measured is what a capture gets: the same cues, the same inference stage, the model file itself.
Conditions are fixed: three exposures ×4 apart of a sensor with 20 ke⁻ and 5 e⁻, gain error 0.3 % per
shot, angle error 0.5°, flash 5 % of the distance above the lens, seeds as below. Views are those of
`gbuffers.pose`; half the materials are test texture sets, half solid noise.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from polcap.formats import onnx
from polcap.images import ColorCalibration, Cues, Floats, Network, Quality, StokesImage, SurfaceMaps, View
from polcap.optics import frames, shade
from polcap.stages import cues, infer
from polcap.training.camera import Errors
from polcap.training.dataset import Light, Photo, Simulator
from polcap.training.watch import held_out

_LIGHTS = 20  # of the rendering error
MAPS = ("diffuse", "specular", "roughness")


@dataclass(frozen=True)
class Params:
    """What one evaluation is told."""

    model: Path
    data: Path = Path("data")
    out: Path = Path("runs/evaluate")
    count: int = 48  # pictures
    size: int = 256  # px
    seed: int = 7


@dataclass(frozen=True)
class Case:
    """One picture: what the camera saw and the truth, camera frame."""

    cues: Cues
    truth: SurfaceMaps
    depth: Floats  # (H, W)


Score = dict[str, float]
Estimator = Callable[[Cues], SurfaceMaps]


def main(params: Params) -> dict[str, Score]:
    """Score all columns; writes out/evaluation.json and out/evaluation.md."""
    torch.set_num_threads(1)
    network = onnx.load(params.model)
    made = cases(params)
    constant = _constants(made)
    columns: dict[str, Estimator] = {
        "network": lambda seen: _estimated(seen, network),
        "analytic": lambda seen: _estimated(seen, None),
        "frontal, mean maps": lambda seen: _flat(seen, constant),
        "silhouette, mean maps": lambda seen: _inflated(seen, constant),
    }
    table: dict[str, Score] = {}
    calibration: list[tuple[Floats, Floats]] = []
    for name, estimator in columns.items():
        rows = []
        for case in made:
            maps = estimator(case.cues)
            rows.append(score(maps, case))
            if name == "network":
                calibration.append((maps.confidence[maps.mask], angle(maps, case)[maps.mask]))
        table[name] = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    result = {"conditions": _conditions(params, network), "table": table, "calibration": deciles(calibration)}
    params.out.mkdir(parents=True, exist_ok=True)
    (params.out / "evaluation.json").write_text(json.dumps(result, indent=1))
    (params.out / "evaluation.md").write_text(_markdown(table))
    return table


def cases(params: Params) -> list[Case]:
    """The fixed pictures, from the seed."""
    device = torch.device("cpu")
    views = -(-params.count // 6)
    simulator = held_out(params.data, params.out / f"views-{params.size}", device, views=views, size=params.size)
    order = np.random.default_rng(params.seed).permutation(len(simulator.views["camera"]))[: params.count]
    made = []
    with torch.random.fork_rng():
        torch.manual_seed(params.seed)
        for index in order:
            seen = simulator.look(np.array([index]), params.size, flip=False)
            photo = simulator.shoot(seen, Light.stated(1, device), Errors.stated(1, device))
            made.append(case(photo, _view(simulator, int(index))))
    return made


def case(photo: Photo, view: View) -> Case:
    """A single photograph as the stages see it. view: of the photograph's grid."""
    mask = photo.mask[0].numpy()

    def image(flat: torch.Tensor) -> Floats:
        out = np.zeros((flat.shape[0], mask.size, 3), dtype=np.float32)
        out[:, photo.at.numpy()] = flat.numpy()
        return out.reshape(-1, *mask.shape, 3)

    quality = np.zeros(mask.size, dtype=np.uint8)
    quality[photo.at.numpy()[photo.clipped.numpy()]] = int(Quality.CLIPPED)
    measured = StokesImage(
        image(photo.stokes), image(photo.covariance), quality.reshape(mask.shape), photo.given[0].numpy(), view, None
    )
    truth = {name: value[0].numpy() for name, value in photo.truth.items()}
    maps = SurfaceMaps(
        normal=np.asarray(frames.from_ray_frame(truth["normal"], photo.rays[0].numpy())),
        diffuse=truth["diffuse"], specular=truth["specular"], roughness=truth["roughness"][..., 0],
        depth_prior=truth["depth"][..., 0], confidence=np.zeros(mask.shape, np.float32),
        mask=mask, view=view, estimator="truth",
    )  # fmt: skip
    return Case(cues.compute(measured, _chart()), maps, truth["depth"][..., 0])


def score(maps: SurfaceMaps, case: Case) -> Score:
    """Errors of one picture over the truth's mask; RMSE unless said, angles in degrees."""
    mask = case.truth.mask
    error = angle(maps, case)
    core = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    out = {
        "normal_mean": float(error[mask].mean()),
        "normal_median": float(np.median(error[mask])),
        "normal_mean_core": float(error[core].mean()),
    }
    for limit in (11.25, 22.5, 30.0):
        out[f"normal_within_{limit:g}"] = float((error[mask] < limit).mean())
    for name in MAPS:
        difference = (getattr(maps, name) - getattr(case.truth, name))[mask]
        out[name] = float(np.sqrt(np.mean(difference**2)))
        out[f"{name}_l1"] = float(np.abs(difference).mean())
    if maps.depth_prior is not None:
        ahead, truth = maps.depth_prior[mask], case.depth[mask]
        difference = (ahead - ahead.mean()) - (truth - truth.mean())
        out["depth"] = float(np.sqrt(np.mean(difference**2)) / np.ptp(truth))
    return out | {"rendering": _rendering_error(maps, case)}


def angle(maps: SurfaceMaps, case: Case) -> Floats:
    """Degrees between estimated and true normal, (H, W)."""
    cosine = np.sum(maps.normal * case.truth.normal, axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def deciles(pairs: list[tuple[Floats, Floats]]) -> list[dict[str, float]]:
    """Mean predicted and mean actual normal error in each tenth of the pixels, by predicted error."""
    predicted, actual = (np.concatenate(part) for part in zip(*pairs))
    order = np.argsort(predicted)
    return [
        {"predicted": float(predicted[part].mean()), "actual": float(actual[part].mean())}
        for part in np.array_split(order, 10)
    ]


def _rendering_error(maps: SurfaceMaps, case: Case) -> float:
    """RMSE of S0 under fixed random lights, in units of the 99th percentile under a light at the camera; 0…1."""
    mask = case.truth.mask
    rng = np.random.default_rng(0)
    ray = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), (int(mask.sum()), 3))
    white = np.percentile(_rendered(case.truth, case, ray), 99)
    squares = []
    for _ in range(_LIGHTS):
        light = rng.normal(size=3) * [0.6, 0.6, 0.3] + [0, 0, 1]
        light = np.broadcast_to((light / np.linalg.norm(light)).astype(np.float32), ray.shape)
        pictures = [np.clip(_rendered(one, case, light) / white, 0, 1) for one in (maps, case.truth)]
        squares.append(np.mean((pictures[0] - pictures[1]) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _rendered(maps: SurfaceMaps, case: Case, light: Floats) -> Floats:
    """S0 (M, 3) of the masked pixels, light (M, 3) in the frame of each ray, refractive index 1.5."""
    mask = case.truth.mask
    normal = frames.to_ray_frame(maps.normal[mask], case.cues.rays[mask])
    one = np.ones(len(normal), np.float32)
    rough = np.maximum(maps.roughness[mask], 0.08)
    stokes = shade.stokes(normal, maps.diffuse[mask], maps.specular[mask], rough, 1.5 * one, light, one)
    return np.asarray(stokes[0])


def _estimated(seen: Cues, network: Network | None) -> SurfaceMaps:
    return infer.estimate(seen, network, infer.Settings())


def _constants(made: list[Case]) -> dict[str, Floats]:
    """The mean of each map over all test pixels: the hardest constant to beat."""
    return {
        name: np.mean([getattr(case.truth, name)[case.truth.mask].mean(axis=0) for case in made], axis=0)
        for name in MAPS
    }


def _flat(seen: Cues, constant: dict[str, Floats]) -> SurfaceMaps:
    """Every normal towards the camera."""
    shape = seen.mask.shape
    return SurfaceMaps(
        normal=seen.rays, diffuse=np.zeros((*shape, 3)) + constant["diffuse"],
        specular=np.zeros((*shape, 3)) + constant["specular"], roughness=np.zeros(shape) + constant["roughness"],
        depth_prior=np.zeros(shape, np.float32), confidence=np.zeros(shape, np.float32),
        mask=seen.mask, view=seen.view, estimator="frontal",
    )  # fmt: skip


def _inflated(seen: Cues, constant: dict[str, Floats]) -> SurfaceMaps:
    """Normals of a balloon: zenith from the distance to the silhouette, azimuth away from the inside."""
    distance = cv2.distanceTransform(seen.mask.astype(np.uint8), cv2.DIST_L2, 5)
    reach = max(float(distance.max()), 1.0)
    height = np.sqrt(np.maximum(reach**2 - (reach - distance) ** 2, 0))
    smooth = cv2.GaussianBlur(height.astype(np.float32), (0, 0), 0.06 * reach + 1)
    down, right = np.gradient(smooth)
    local = np.stack([-right, down, np.ones_like(right)], axis=-1)
    local = local / np.linalg.norm(local, axis=-1, keepdims=True)
    return replace(
        _flat(seen, constant), normal=np.asarray(frames.from_ray_frame(local, seen.rays)),
        depth_prior=-smooth / np.sqrt(seen.mask.sum() / np.pi), estimator="silhouette",
    )  # fmt: skip


def _chart() -> ColorCalibration:
    return ColorCalibration(np.eye(3, dtype=np.float32), None, None, None, "chart", 0.0, None)


def _view(simulator: Simulator, index: int) -> View:
    focal, x, y = (float(a) for a in simulator.views["camera"][index, :3])
    return View(focal=focal, center=(x, y), scale=1.0)


def _conditions(params: Params, network: Network) -> dict[str, str | int]:
    return {
        "pictures": params.count, "size": params.size, "seed": params.seed, "model": network.digest,
        "version": network.metadata.get("version", ""),
    }  # fmt: skip


def _markdown(table: dict[str, Score]) -> str:
    names = list(table)
    lines = ["| | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for row in next(iter(table.values())):
        cells = (f"{table[name][row]:.4g}" if row in table[name] else "–" for name in names)
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
