"""How the light of each material falls with the angle: radiance over zenith, gathered from soft groups of places.

A material's gloss shows wherever it faces the flash, and nowhere else. Places are sorted into groups, by
learned features and, each picture anew, by diffuse color; each group's light is averaged in bins of the
estimated zenith, and what that profile says of gloss is told to every place of the group.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.optics import fresnel
from polcap.stages.cues import NOMINAL_IOR

_GROUPS = 16
_EDGES_DEG = (0.0, 4.0, 8.0, 12.0, 17.0, 23.0, 30.0, 40.0, 52.0, 66.0, 90.0)
_BINS = len(_EDGES_DEG) - 1
_FIGURES = 6  # per bin
_COLORS = 8  # groups by color
_ALIKE = 0.15  # 1σ within a group, ln of albedo
_ROUNDS = 2  # of k-means


class Profiles(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Features of each place (B, C, H, W) and what the picture shows -> messages (B, outputs, H, W)."""

    def __init__(self, features: int, outputs: int) -> None:
        super().__init__()
        self.sort = nn.Conv2d(features, _GROUPS, 1)
        self.read = nn.Sequential(nn.Linear(_BINS * _FIGURES, 96), nn.ReLU(), nn.Linear(96, outputs))

    def forward(self, features: Tensor, figures: Tensor, zenith: Tensor, usable: Tensor) -> Tensor:
        """figures (B, ·, ·, ·) of `figures_of`, cosine of the zenith and usable (B, 1, ·, ·), twice as fine."""
        batch, _, height, width = features.shape
        member = torch.softmax(self.sort(features).float(), dim=1)
        weight = F.interpolate(member, scale_factor=2.0, mode="bilinear", align_corners=False) * usable
        told = self.read(_profile(weight.flatten(2), figures.flatten(2), zenith.flatten(2)))  # (B, groups, outputs)
        return (told.transpose(1, 2) @ member.flatten(2)).reshape(batch, -1, height, width)


class ColorProfiles(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """What is told to each group of `by_color`; a print's colors lie side by side, too fine for coarse features."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.read = nn.Sequential(nn.Linear(_BINS * _FIGURES, 96), nn.ReLU(), nn.Linear(96, outputs))
        nn.init.zeros_(self.read[2].weight)
        nn.init.zeros_(self.read[2].bias)

    def forward(self, member: Tensor, figures: Tensor, zenith: Tensor, usable: Tensor) -> Tensor:
        """member (B, groups, H, W), the others (B, ·, H, W) as for `Profiles` -> (B, outputs, groups)."""
        profile = _profile((member * usable).flatten(2), figures.flatten(2), zenith.flatten(2))
        told: Tensor = self.read(profile).transpose(1, 2)
        return told


@torch.no_grad()  # type: ignore[untyped-decorator]
def by_color(diffuse: Tensor, inside: Tensor) -> Tensor:
    """Soft groups of like color in each picture, (B, groups, H, W): k-means from colors that lie far apart.

    diffuse (B, 3, H, W) linear; inside (B, 1, H, W) 1 on the object.
    """
    color = torch.log(diffuse.float() + 0.02)
    some, weight = (image[:, :, 1::4, 1::4].flatten(2) for image in (color, inside.float()))
    mean = (some * weight).sum(dim=2, keepdim=True) / (weight.sum(dim=2, keepdim=True) + 1e-4)
    centers: list[Tensor] = []
    distance = _square(some, mean) * weight
    while len(centers) < _COLORS:
        farthest = distance.argmax(dim=2, keepdim=True)
        centers.append(some.gather(2, farthest.expand(-1, 3, -1)))
        nearer = _square(some, centers[-1]) * weight
        distance = nearer if len(centers) == 1 else torch.minimum(distance, nearer)
    center = torch.cat(centers, dim=2)  # (B, 3, groups)
    for _ in range(_ROUNDS):
        share = (_nearness(some, center) * weight)[:, None]  # (B, 1, groups, N)
        center = ((share * some[:, :, None]).sum(dim=3) + 1e-3 * center) / (share.sum(dim=3) + 1e-3)
    return _nearness(color.flatten(2), center).reshape(len(color), _COLORS, *color.shape[2:])


def _nearness(color: Tensor, center: Tensor) -> Tensor:
    """Share (B, groups, N) that each center (B, 3, groups) has of each color (B, 3, N)."""
    square = torch.cat([_square(color, one) for one in center.split(1, dim=2)], dim=1)
    return torch.softmax(-square / (2 * _ALIKE**2), dim=1)


def _square(color: Tensor, center: Tensor) -> Tensor:
    return (color - center).square().mean(dim=1, keepdim=True)


def figures_of(level: Tensor, ratio: Tensor, normal: Tensor, diffuse: Tensor) -> Tensor:
    """What is averaged, (B, 5, H, W): log of light over shading, its excess over the diffuse light, the excess
    squared and as a factor, and the share by which the DoLP falls short of the diffuse one.

    level (B, 3, H, W) log radiance, ratio (B, 2, H, W) S1/S0 and S2/S0, normal and diffuse (B, 3, H, W).
    """
    cosine = normal[:, 2:].clamp(0.03, 1.0)
    plus, minus = fresnel.transmission(cosine, NOMINAL_IOR)
    shading = 0.96 * cosine * plus
    light = (torch.exp(level) - 0.02).clamp(0, 50).mean(dim=1, keepdim=True)
    body = diffuse.mean(dim=1, keepdim=True) * shading
    excess = torch.log((light + 0.02) / (body + 0.02)).clamp(-3, 4)
    dolp = ratio.square().sum(dim=1, keepdim=True).sqrt()
    short = (1 - dolp / (minus / plus + 0.005)).clamp(-1, 1)
    return torch.cat([torch.log(light / shading + 0.02), excess, excess**2, torch.exp(2 * excess), short], dim=1)


def _profile(weight: Tensor, figures: Tensor, cosine: Tensor) -> Tensor:
    """weight (B, groups, N), figures (B, 5, N), cosine (B, 1, N) -> per group and bin: log share of the group,
    then the figures' means, 0 where there is nothing; (B, groups, bins · 6)."""
    edges = torch.cos(torch.deg2rad(torch.tensor(_EDGES_DEG, device=cosine.device))).view(1, -1, 1)
    at = ((cosine <= edges[:, :-1]) & (cosine > edges[:, 1:])).to(weight.dtype)  # (B, bins, N)
    seen = torch.cat([torch.ones_like(cosine), figures], dim=1)
    sums = weight @ (at[:, :, None] * seen[:, None]).flatten(1, 2).transpose(1, 2)
    sums = sums.unflatten(2, (_BINS, _FIGURES))
    share, total = sums[..., :1], sums[..., :1].sum(dim=2, keepdim=True) + 1e-3
    mean = sums[..., 1:] / (share + 1e-4 * total)
    light, excess, square, factor, short = mean.unbind(dim=-1)
    whole = sums[..., 1].sum(dim=2, keepdim=True) / total[..., 0]  # of the light over shading
    columns = (
        torch.log(share[..., 0] / total[..., 0] + 1e-3) / 3, light - whole, excess, torch.log1p(factor), square, short,
    )  # fmt: skip
    return torch.stack(columns, dim=-1).flatten(2)
