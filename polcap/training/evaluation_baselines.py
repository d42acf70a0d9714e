"""Baselines of the evaluation: maps estimated without a network, and by networks alone at a reduced size."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from polcap.errors import InputError
from polcap.images import Cues, Floats, SurfaceMaps
from polcap.optics import frames
from polcap.stages.cues import channels
from polcap.training import main_network, train
from polcap.training.evaluation_protocol import Case, Protocol

Estimator = Callable[[Case], SurfaceMaps]
_MEAN_SIZE = 96  # px, of the pictures for the mean maps


def frontal(seen: Cues) -> SurfaceMaps:
    """All normals towards the camera, the radiance as albedo, the gloss of a common dielectric."""
    shape = seen.mask.shape
    return SurfaceMaps(
        normal=seen.rays, diffuse=np.clip(seen.radiance, 0, 1), specular=np.full((*shape, 3), 0.04, np.float32),
        roughness=np.full(shape, 0.5, np.float32), depth_prior=np.zeros(shape, np.float32),
        confidence=np.zeros(shape, np.float32), mask=seen.mask, view=seen.view, estimator="frontal",
    )  # fmt: skip


def inflated(seen: Cues) -> SurfaceMaps:
    """Normals of an inflated silhouette: zenith by the distance to the outline, azimuth towards the outline."""
    distance = cv2.distanceTransform(seen.mask.astype(np.uint8), cv2.DIST_L2, 5)
    reach = max(float(distance.max()), 1.0)
    height = np.sqrt(np.maximum(reach**2 - (reach - distance) ** 2, 0))
    smooth = cv2.GaussianBlur(height.astype(np.float32), (0, 0), 0.06 * reach + 1)
    down, right = np.gradient(smooth)
    local = np.stack([-right, down, np.ones_like(right)], axis=-1)
    local = local / np.linalg.norm(local, axis=-1, keepdims=True)
    return replace(
        frontal(seen), normal=np.asarray(frames.from_ray_frame(local, seen.rays)),
        diffuse=np.clip(seen.radiance / np.maximum(local[..., 2:], 0.2), 0, 1),
        depth_prior=-smooth / np.sqrt(seen.mask.sum() / np.pi), estimator="silhouette",
    )  # fmt: skip


Means = tuple[Floats, Floats, Floats, Floats]  # normal in the frame of a ray, diffuse, specular, roughness


def mean_maps(protocol: Protocol, count: int) -> Means:
    """Mean of each map over all pictures of the evaluation, with equal weights: the best constants."""
    rows = []
    for number in range(count):
        truth = protocol.truth(number, min(_MEAN_SIZE, protocol.size))
        mask = truth.mask
        local = frames.to_ray_frame(truth.normal, frames.rays(truth.view, *mask.shape))
        rows.append([image[mask].mean(axis=0) for image in (local, truth.diffuse, truth.specular, truth.roughness)])
    normal, diffuse, specular, roughness = (np.mean(part, axis=0) for part in zip(*rows))
    return normal / np.linalg.norm(normal), diffuse, specular, roughness


def constant(seen: Cues, values: Means) -> SurfaceMaps:
    """Maps with the same values at all pixels."""
    normal, diffuse, specular, roughness = values
    shape = (*seen.mask.shape, 3)
    return replace(
        frontal(seen), normal=np.asarray(frames.from_ray_frame(np.broadcast_to(normal, shape), seen.rays)),
        diffuse=np.broadcast_to(diffuse, shape), specular=np.broadcast_to(specular, shape),
        roughness=np.full(shape[:2], roughness), estimator="mean",
    )  # fmt: skip


def find_checkpoints(folder: Path) -> dict[str, Path]:
    """Checkpoints folder/NAME/last.pt by name.

    Raises
    ------
    InputError
        There are none.
    """
    found = {path.parent.name: path for path in sorted(folder.glob("*/last.pt"))}
    if not found:
        raise InputError(f"{folder} holds no NAME/last.pt; first train with `polcap train DATA --out {folder}/NAME`")
    return found


def network_alone(checkpoint: Path) -> Estimator:
    """Estimates by the averaged weights of a checkpoint alone, on the picture binned to about the size of training."""
    network, _ = train.load_average(checkpoint)

    def estimate(case: Case) -> SurfaceMaps:
        picture = channels(case.small)
        height, width = picture.shape[1:]
        multiple = main_network.SIZE_MULTIPLE
        padded = np.pad(picture, ((0, 0), (0, -height % multiple), (0, -width % multiple))).astype(np.float32)
        with torch.no_grad():
            maps = network(torch.from_numpy(padded)[None])
        by = int(case.small.view.scale)

        def enlarged(name: str) -> Floats:
            image = np.ascontiguousarray(maps[name][0].float().permute(1, 2, 0).numpy()[:height, :width])
            larger = cv2.resize(image, (width * by, height * by))
            rest = [(0, n - m) for n, m in zip(case.cues.mask.shape, larger.shape)]
            return np.asarray(np.pad(larger, [*rest, *[(0, 0)] * (larger.ndim - 2)], mode="edge"))

        normal = frames.from_ray_frame(enlarged("normal"), case.cues.rays)
        return SurfaceMaps(
            normal=np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)),
            diffuse=enlarged("diffuse"), specular=enlarged("specular"), roughness=enlarged("roughness"),
            depth_prior=enlarged("depth"), confidence=enlarged("sigma"), mask=case.cues.mask, view=case.cues.view,
            estimator=checkpoint.parent.name,
        )  # fmt: skip

    return estimate
