"""Baselines of the evaluation: maps estimated without a network, and by networks alone at a reduced size."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional as F

from polcap.errors import InputError
from polcap.optics import frames
from polcap.optics.outline import disc_radius
from polcap.stage_values import Cues, SurfaceMaps
from polcap.stages.cues import channels
from polcap.training import main_network, train
from polcap.training.evaluation_protocol import Case, Protocol

Estimator = Callable[[Case], SurfaceMaps]
Means = tuple[tuple[float, ...], ...]  # normal in the frame of a ray, diffuse, specular, roughness
_MEAN_SIZE = 96  # px, of the pictures for the mean maps


def frontal(seen: Cues) -> SurfaceMaps:
    """Baseline maps: all normals towards the camera, the radiance as albedo, the gloss of a common dielectric."""
    shape = seen.mask.shape
    return SurfaceMaps(
        normal=seen.rays, diffuse=np.clip(seen.radiance, 0, 1), specular=np.full((*shape, 3), 0.04, np.float32),
        roughness=np.full(shape, 0.5, np.float32), depth_prior=np.zeros(shape, np.float32),
        confidence=np.zeros(shape, np.float32), mask=seen.mask, view=seen.view, estimator="frontal",
    )  # fmt: skip


def inflated(seen: Cues) -> SurfaceMaps:
    """Baseline maps with normals of an inflated silhouette: zenith by distance to the outline, azimuth towards it."""
    distance = cv2.distanceTransform(seen.mask.astype(np.uint8), cv2.DIST_L2, 5)
    reach = max(float(distance.max()), 1.0)
    height = np.sqrt(np.maximum(reach**2 - (reach - distance) ** 2, 0))
    smooth = cv2.GaussianBlur(height.astype(np.float32), (0, 0), 0.06 * reach + 1)
    down, right = np.gradient(smooth)
    local = frames.unit(np.stack([-right, down, np.ones_like(right)], axis=-1))
    return replace(
        frontal(seen), normal=np.asarray(frames.from_ray_frame(local, seen.rays)),
        diffuse=np.clip(seen.radiance / np.maximum(local[..., 2:], 0.2), 0, 1),
        depth_prior=-smooth / disc_radius(seen.mask), estimator="silhouette",
    )  # fmt: skip


def mean_maps(protocol: Protocol, count: int) -> Means:
    """Mean value of each true map over all evaluation pictures, with equal weights: the best constant estimate."""
    rows = []
    for number in range(count):
        truth = protocol.truth(number, min(_MEAN_SIZE, protocol.size))
        local = frames.to_ray_frame(truth.normal, frames.rays(truth.view, *truth.mask.shape))
        images = local, truth.diffuse, truth.specular, truth.roughness[..., None]
        rows.append([image[truth.mask].mean(axis=0) for image in images])
    normal, *others = (np.mean(part, axis=0) for part in zip(*rows))
    return tuple(tuple(mean.tolist()) for mean in (normal / np.linalg.norm(normal), *others))


def constant(seen: Cues, values: Means) -> SurfaceMaps:
    """Baseline maps with the same values (from `mean_maps`) at all pixels.

    The normal is the same in the frame of each pixel's view ray.
    """
    normal, diffuse, specular, roughness = (np.broadcast_to(v, (*seen.mask.shape, len(v))) for v in values)
    return replace(
        frontal(seen), normal=np.asarray(frames.from_ray_frame(normal, seen.rays)), diffuse=diffuse, specular=specular,
        roughness=roughness[..., 0], estimator="mean",
    )  # fmt: skip


def find_checkpoints(folder: Path | None) -> dict[str, Path]:
    """Checkpoints folder/NAME/last.pt of ablations, by name. Raises InputError if the folder has none."""
    found = {path.parent.name: path for path in sorted(folder.glob("*/last.pt"))} if folder else {}
    if folder and not found:
        raise InputError(f"{folder} holds no NAME/last.pt; first train with `polcap train DATA --out {folder}/NAME`")
    return found


def network_alone(checkpoint: Path) -> Estimator:
    """Estimator that runs only the network of a checkpoint, with averaged weights, on reduced pictures."""
    network, _ = train.load_average(checkpoint)

    def estimate(case: Case) -> SurfaceMaps:
        picture = channels(case.small)
        height, width = picture.shape[1:]
        multiple = main_network.SIZE_MULTIPLE
        padded = np.pad(picture, ((0, 0), (0, -height % multiple), (0, -width % multiple))).astype(np.float32)
        with torch.no_grad():
            maps = network(torch.from_numpy(padded)[None])
        by, (high, wide) = int(case.small.view.scale), case.cues.mask.shape
        enlarged = {}
        for name, image in maps.items():
            larger = F.interpolate(image[:, :, :height, :width].float(), scale_factor=by, mode="bilinear")
            larger = F.pad(larger, (0, wide - width * by, 0, high - height * by), mode="replicate")
            enlarged[name] = larger[0].permute(1, 2, 0).numpy()
        normal = frames.from_ray_frame(enlarged["normal"], case.cues.rays)
        return SurfaceMaps(
            normal=frames.unit(normal),
            diffuse=enlarged["diffuse"], specular=enlarged["specular"], roughness=enlarged["roughness"][..., 0],
            depth_prior=enlarged["depth"][..., 0], confidence=enlarged["sigma"][..., 0], mask=case.cues.mask,
            view=case.cues.view, estimator=checkpoint.parent.name,
        )  # fmt: skip

    return estimate
