"""Loss of the main network: the error of each map, and of pictures rendered from all maps.

The rendering loss is that of Deschaintre, Lin & Ghosh (CVPR 2021). The polarized renderer `optics/shade.py` renders
truth and estimate under random lights and from random sides. The loss compares log S0, and the linear polarization
relative to S0. So it couples maps that are ambiguous one by one.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from polcap.optics import shade
from polcap.optics.body import Law
from polcap.stages.cues import NOMINAL_IOR
from polcap.training.simulator import Batch

WEIGHTS = {  # factors on the parts of the loss
    "normal": 2.0, "region": 1.0, "depth": 1.0, "diffuse": 1.0, "specular": 60.0, "roughness": 8.0, "highlight": 2.0,
    "sigma": 0.05, "render": 0.3,
}  # fmt: skip
_BLOCKS = (8, 16, 32)  # px: sizes of regions
_FLAT = 0.2  # length of the mean tangential part of the normals below which a region has no clear azimuth
_MIN_ROUGHNESS = 0.08  # of rendered surfaces


def total(
    maps: dict[str, Tensor], truth: Batch, random: torch.Generator | None, *, polarized: bool = True
) -> tuple[Tensor, dict[str, float]]:
    """Training loss of estimated maps (B, ·, H, W), and its parts as numbers by name.

    `random` draws the lights of the rendering loss; without `polarized` that loss compares S0 alone.
    """
    mask = truth.mask
    inside = mask[:, None].float()
    area = inside.sum().clamp(min=1)

    def mean(error: Tensor) -> Tensor:
        return (error * inside).sum() / (area * error.shape[1])

    cosine = (maps["normal"] * truth.normal).sum(dim=1, keepdim=True)
    angle = normal_error(maps["normal"], truth.normal)
    parts = {
        "normal": mean(1 - cosine) + 0.25 * mean((maps["normal"] - truth.normal).abs()),
        "region": _region(maps["normal"], truth.normal, inside),
        "depth": mean((centered(maps["depth"], inside) - centered(truth.depth, inside)).abs()),
        "diffuse": mean((maps["diffuse"] - truth.diffuse).abs() + 2 * (maps["diffuse"] - truth.diffuse) ** 2),
        # squares: their minimum is the mean of all possible values; the median of F0 would ignore its long tail
        "specular": mean((maps["specular"] - truth.specular) ** 2),
        "roughness": mean((maps["roughness"] - truth.roughness) ** 2),
        "highlight": mean((maps["highlight"] - truth.highlight) ** 2),
        "sigma": mean(torch.log(maps["sigma"]) + angle.detach() / maps["sigma"]),  # minimal at sigma = E[angle]
    }
    parts["render"] = _rendered(maps, truth, random, polarized)
    loss = sum((WEIGHTS[name] * value for name, value in parts.items()), torch.zeros((), device=mask.device))
    figures = {name: float(value.detach()) for name, value in parts.items()}
    return loss, figures | {"degrees": float(mean(angle).detach()), "loss": float(loss.detach())}


def _region(estimate: Tensor, truth: Tensor, inside: Tensor) -> Tensor:
    """Loss of regions with a common azimuth error; a loss per pixel would not count it more than scattered errors.

    For blocks of 8, 16 and 32 px: 1 − cosine between the mean tangential parts of estimate and truth, times the length
    of the truth's. Parts shorter than `_FLAT` are not scaled to unit length, so that an estimate with the opposite
    azimuth can shrink to 0 and grow towards the true azimuth.
    """
    cost, area = truth.new_zeros(()), truth.new_zeros(())
    for block in _BLOCKS:
        share = F.avg_pool2d(inside, block)
        estimated, true = (F.avg_pool2d(n[:, :2] * inside, block) / share.clamp(min=1e-3) for n in (estimate, truth))
        azimuth, true_azimuth = (v / (v.square().sum(dim=1, keepdim=True) + _FLAT**2).sqrt() for v in (estimated, true))
        missed = 0.5 * (azimuth - true_azimuth).square().sum(dim=1, keepdim=True)  # 1 − cosine
        cost = cost + (missed * true.norm(dim=1, keepdim=True) * share).sum()
        area = area + share.sum()
    return cost / area.clamp(min=1)


def normal_error(estimate: Tensor, truth: Tensor) -> Tensor:
    """Angle [°] between unit normals (B, 3, H, W), (B, 1, H, W)."""
    return torch.rad2deg(2 * torch.asin((estimate - truth).norm(dim=1, keepdim=True).clamp(max=2) / 2))


def centered(depth: Tensor, inside: Tensor) -> Tensor:
    """Subtract from depth (B, 1, H, W) its mean over the pixels `inside` (B, 1, H, W; 0 or 1)."""
    return depth - (depth * inside).sum(dim=(2, 3), keepdim=True) / inside.sum(dim=(2, 3), keepdim=True).clamp(min=1)


def _rendered(maps: dict[str, Tensor], truth: Batch, random: torch.Generator | None, polarized: bool) -> Tensor:
    """Loss of pictures rendered from the estimated maps, under a random light and view for each pixel.

    Only every second pixel of every second row is rendered.
    """
    at = truth.mask[:, ::2, ::2].reshape(-1).nonzero()[:, 0]

    def flat(image: Tensor) -> Tensor:
        return image[:, :, ::2, ::2].permute(0, 2, 3, 1).reshape(-1, image.shape[1])[at]

    # a random view: normals are turned by up to 0.5 rad about a random axis perpendicular to the ray
    turn = _small_rotations(len(at), truth.normal.device, random)
    ones = torch.ones(len(at), device=turn.device)
    light = 0.6 * torch.randn(len(at), 3, device=turn.device, generator=random)
    light = F.normalize(torch.cat([light[:, :2], light[:, 2:] + 1], dim=1), dim=1)
    law = Law(*flat(truth.law).unbind(dim=1))
    pictures = []
    for source in (maps, {name: getattr(truth, name) for name in ("normal", "diffuse", "specular", "roughness")}):
        normal = torch.einsum("mij,mj->mi", turn, flat(source["normal"]))
        rough = flat(source["roughness"])[:, 0].clamp(min=_MIN_ROUGHNESS)
        diffuse, specular = flat(source["diffuse"]), flat(source["specular"])
        pictures.append(shade.stokes(normal, diffuse, specular, rough, NOMINAL_IOR * ones, light, ones, law))
    estimate, target = pictures
    intensity = (torch.log(estimate[0] + 0.05) - torch.log(target[0] + 0.05)).abs().mean()
    if not polarized:
        return intensity
    polarization = (estimate[1:] - target[1:]).abs() / (target[0] + 0.05)
    return intensity + 2.0 * polarization.clamp(max=1.0).mean()


def _small_rotations(count: int, device: torch.device, random: torch.Generator | None) -> Tensor:
    """Random rotations (M, 3, 3) of the view by up to 0.5 rad about axes perpendicular to z."""
    azimuth = 2 * torch.pi * torch.rand(count, device=device, generator=random)
    c, s = torch.cos(azimuth), torch.sin(azimuth)
    tilt = 0.5 * torch.rand(count, device=device, generator=random)
    cos_tilt, sin_tilt = torch.cos(tilt), torch.sin(tilt)
    zero = torch.zeros_like(c)
    x = torch.stack([cos_tilt * c * c + s * s, (cos_tilt - 1) * c * s, sin_tilt * c], dim=1)
    y = torch.stack([(cos_tilt - 1) * c * s, cos_tilt * s * s + c * c, sin_tilt * s], dim=1)
    z = torch.stack([-sin_tilt * c, -sin_tilt * s, cos_tilt + zero], dim=1)
    return torch.stack([x, y, z], dim=1)
