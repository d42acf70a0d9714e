"""Part of the main network that estimates gloss from profiles: light against zenith angle, for groups of pixels.

The gloss of a material is visible only where it faces the flash. So learned features divide the pixels into groups of
one material each. The light of a group is averaged in bins of the estimated zenith, and every pixel of the group gets
the gloss that follows from this profile.
"""

from dataclasses import dataclass
from math import cos, radians

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.optics import fresnel
from polcap.stages.cues import FLOOR, NOMINAL_IOR

_GROUPS = 16
_EDGES_DEG = (0.0, 4.0, 8.0, 12.0, 17.0, 23.0, 30.0, 40.0, 52.0, 66.0, 90.0)
_BINS = len(_EDGES_DEG) - 1
_FIGURES = 6  # per bin
PROFILE = _BINS * _FIGURES
_BLOCK = 64  # pixels summed at once; divides their number, because sides at half resolution are multiples of 16


@dataclass(frozen=True)
class GlossEvidence:
    """Inputs of the network's gloss estimate at each pixel, (B, ·, H, W)."""

    figures: Tensor  # 5 channels of `figures_of`
    cosine: Tensor  # of the zenith
    diffuse: Tensor  # 3 channels
    usable: Tensor  # 1 on the object where it is not clipped, else 0


class Profiles(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Network part that reads gloss (B, outputs, H, W) from profiles of light against zenith, one per group."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__()
        self.sort = nn.Conv2d(coarse, _GROUPS, 1)  # scores of the groups for a region
        self.part = nn.Sequential(nn.Conv2d(fine + 6, 32, 1), nn.ReLU(), nn.Conv2d(32, _GROUPS, 1))
        self.read = nn.Sequential(nn.Linear(PROFILE, 96), nn.ReLU(), nn.Linear(96, outputs))
        nn.init.zeros_(self.part[-1].weight)
        nn.init.zeros_(self.part[-1].bias)

    def forward(self, coarse: Tensor, fine: Tensor, seen: GlossEvidence) -> Tensor:
        """Estimate gloss (B, outputs, H, W) from features that assign pixels to groups.

        Coarse features (B, ·, H/2, W/2) assign regions, fine features (B, ·, H, W) pixels within a region.
        """
        color = torch.log(seen.diffuse + 0.02)  # finite for black
        weight = seen.usable + 1e-4  # not 0 everywhere
        deviation = color - (color * weight).sum(dim=(2, 3), keepdim=True) / weight.sum(dim=(2, 3), keepdim=True)
        region = F.interpolate(self.sort(coarse).float(), scale_factor=2.0, mode="bilinear", align_corners=False)
        pixel = self.part(torch.cat([fine, color.to(fine.dtype), deviation.to(fine.dtype)], dim=1)).float()
        share = torch.softmax(region + pixel, dim=1)  # (B, groups, H, W) of each pixel in each group
        gloss = self.read(profile((share * seen.usable).flatten(2), seen.figures.flatten(2), seen.cosine.flatten(2)))
        return (gloss.transpose(1, 2) @ share.flatten(2)).unflatten(2, share.shape[2:])  # gloss: (B, groups, outputs)


def figures_of(log_radiance: Tensor, ratio: Tensor, normal: Tensor, diffuse: Tensor) -> Tensor:
    """Compute the five quantities (B, 5, H, W) that the gloss profiles average in bins of zenith angle.

    They are the log of light / shading; the log e of light / diffuse light; e²; exp 2e; the missing share of the DoLP
    of diffuse light. log_radiance, normal and diffuse are (B, 3, H, W), ratio (B, 2, H, W) is S1/S0 and S2/S0.
    """
    cosine = normal[:, 2:].clamp(0.03, 1.0)
    plus, minus = fresnel.transmission(cosine, NOMINAL_IOR)
    shading = 0.96 * cosine * plus  # 0.96: transmittance at normal incidence
    light = (torch.exp(log_radiance) - FLOOR).clamp(0, 50).mean(dim=1, keepdim=True)
    body = diffuse.mean(dim=1, keepdim=True) * shading
    excess = torch.log((light + 0.02) / (body + 0.02)).clamp(-3, 4)
    dolp = ratio.square().sum(dim=1, keepdim=True).sqrt()
    missing = (1 - dolp / (minus / plus + 0.005)).clamp(-1, 1)
    return torch.cat([torch.log(light / shading + 0.02), excess, excess**2, torch.exp(2 * excess), missing], dim=1)


def profile(weight: Tensor, figures: Tensor, cosine: Tensor) -> Tensor:
    """Average quantities in bins of zenith, per group of pixels: profiles (B, groups, bins · 6).

    weight (B, groups, N) assigns N pixels to groups, figures are (B, 5, N), cosine (B, 1, N) is that of the zenith. A
    bin has six numbers: the log of its share of the group, and the means of the five figures.
    """
    edges = cosine.new_tensor([cos(radians(angle)) for angle in _EDGES_DEG]).view(1, -1, 1)
    in_bin = ((cosine <= edges[:, :-1]) & (cosine > edges[:, 1:])).to(weight.dtype)  # (B, bins, N)
    values = torch.cat([torch.ones_like(cosine), figures], dim=1)
    sums = summed(weight, (in_bin[:, :, None] * values[:, None]).flatten(1, 2).transpose(1, 2))
    sums = sums.unflatten(2, (_BINS, _FIGURES))
    pixels, total = sums[..., :1], sums[..., :1].sum(dim=2, keepdim=True) + 1e-3
    mean = sums[..., 1:] / (pixels + 1e-4 * total)
    light, excess, square, factor, missing = mean.unbind(dim=-1)
    light = light - sums[..., 1].sum(dim=2, keepdim=True) / total[..., 0]  # relative to the mean of all bins
    share = torch.log(pixels[..., 0] / total[..., 0] + 1e-3) / 3
    columns = share, light, excess, torch.log1p(factor), square, missing
    return torch.stack(columns, dim=-1).flatten(2)


def summed(weight: Tensor, values: Tensor) -> Tensor:
    """Matrix product of weight (B, G, N) and values (B, N, K), in blocks of N that are added in a fixed order.

    onnxruntime 1.32 divides a long sum by its number of threads, so that the last bits of one product would depend on
    it.
    """
    blocks = weight.unflatten(2, (-1, _BLOCK)).transpose(1, 2) @ values.unflatten(1, (-1, _BLOCK))  # (B, ·, G, K)
    return blocks.sum(dim=1)
