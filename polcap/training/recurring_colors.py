"""The colors of a picture as a few that recur: what a place's albedo is, and what its color says of its gloss.

An object wears few colors, seen under many angles. Where a place is seen badly, at the limb or under a
wide highlight, the colors seen well elsewhere tell what its albedo can be; and a color that shows no
highlight wherever it faces the flash is rough, however glossy the print beside it. The colors are the
picture's own, a mixture of Gaussians found anew in each; nothing about them is learned.
"""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor, nn

from polcap.training.gloss_profiles import PROFILE, GlossEvidence, profile

COLORS = 8
_OFFSET = 0.02  # of albedo, before its logarithm
_AXES = ((3**-0.5, 3**-0.5, 3**-0.5), (2**-0.5, -(2**-0.5), 0.0), (6**-0.5, 6**-0.5, -2 * 6**-0.5))  # light, hues
_KNOTS_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 65.0, 70.0, 75.0, 80.0, 90.0)
_LIGHT_DOUBT = (0.4, 0.35, 0.3, 0.2, 0.17, 0.17, 0.27, 0.37, 0.48, 0.6, 0.7, 0.8)  # 1σ along the axes at these
_HUE_DOUBT = 0.3  # of that
_CLIPPED = 0.5  # 1σ more
_MOST = 3.0  # that a place's doubt may differ from what its zenith lets expect, in the logarithm
_SURE = 0.2  # doubt of lightness under which a place has its whole say in what the colors are
_WIDTH = 0.2  # of a color before its own is known
_FINEST = 0.05
_ROUNDS = (5, 7)  # with that width, with their own


@dataclass(frozen=True)
class ColorMixture:
    """Colors of each picture on the axes of `_opponent`, (B, COLORS, ·)."""

    center: Tensor  # 3
    variance: Tensor  # 3
    share: Tensor  # 1


class Recolor(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Albedo drawn towards the colors of its picture, as far as it is in doubt."""

    def __init__(self) -> None:
        super().__init__()
        light = torch.log(torch.tensor(_LIGHT_DOUBT))
        hue = light + torch.log(torch.tensor(_HUE_DOUBT))
        self.knots = nn.Parameter(torch.stack([light, hue]))  # log of 1σ over zenith

    def forward(
        self, diffuse: Tensor, doubt: Tensor, cosine: Tensor, inside: Tensor, clipped: Tensor
    ) -> tuple[Tensor, Tensor, ColorMixture]:
        """Albedo (B, 3, H, W), each place's share in the colors (B, COLORS, H, W), and the colors.

        doubt (B, 2, H, W) is added to the logarithm of what the zenith lets expect, for light and for hue; cosine of
        the zenith, inside and clipped (B, 1, H, W).
        """
        color = _opponent(diffuse)
        expected = _hats(cosine.flatten(2)) @ self.knots.T
        sigma = torch.exp(expected.transpose(1, 2).reshape(doubt.shape) + doubt.clamp(-_MOST, _MOST))
        weight = inside * (1 - clipped) * (_SURE / sigma[:, :1]).square().clamp(max=1) + 1e-6
        colors = fit_mixture(*(part[:, :, ::2, ::2].flatten(2).detach() for part in (color, weight)))
        spread = (sigma + _CLIPPED * clipped)[:, [0, 1, 1]].square()
        moved, member = _drawn(color.flatten(2), spread.flatten(2), colors)
        axes = color.new_tensor(_AXES)
        out = (torch.exp(axes.T @ moved) - _OFFSET).clamp(1e-3, 1.0)
        batch, _, height, width = diffuse.shape
        return out.reshape(batch, 3, height, width), member.reshape(batch, COLORS, height, width), colors


def _opponent(diffuse: Tensor) -> Tensor:
    """Logarithms of albedo (B, 3, H, W) on the axes of lightness and of two hues."""
    return torch.einsum("ij,bjhw->bihw", diffuse.new_tensor(_AXES), torch.log(diffuse + _OFFSET))


def _hats(cosine: Tensor) -> Tensor:
    """Weights (B, N, knots) of linear interpolation between the knots at cosines (B, 1, N)."""
    knots = cosine.new_tensor(_KNOTS_DEG)
    angle = (torch.acos(cosine.clamp(0, 1 - 1e-6)) * (180 / pi)).transpose(1, 2)
    steps = ((angle - knots[:-1]) / (knots[1:] - knots[:-1])).clamp(0, 1)  # how far past each knot
    one = torch.ones_like(angle)
    return torch.cat([one, steps], dim=2) - torch.cat([steps, 0 * one], dim=2)


@torch.no_grad()  # type: ignore[untyped-decorator]
def fit_mixture(color: Tensor, weight: Tensor) -> ColorMixture:
    """Expectation-maximization for colors (B, 3, N) with weights (B, 1, N).

    The centers begin at the corners of the colors' spread; first all have one width, so that centers of one color
    fall together, then each its own.
    """
    total = weight.sum(dim=2, keepdim=True)
    mean = (color * weight).sum(dim=2, keepdim=True) / total
    spread = (((color - mean) ** 2 * weight).sum(dim=2, keepdim=True) / total).sqrt()
    corner = torch.cartesian_prod(*[color.new_tensor([-1.0, 1.0])] * 3)
    center = mean.transpose(1, 2) + corner * spread.transpose(1, 2)
    variance = torch.full_like(center, _WIDTH**2)
    share = torch.full_like(center[..., :1], 1 / COLORS)
    both = torch.cat([color, color * color], dim=1)
    seen = torch.cat([both, torch.ones_like(weight)], dim=1).transpose(1, 2)
    for step in range(sum(_ROUNDS)):
        ways = torch.cat([center / variance, -0.5 / variance], dim=2)
        level = torch.log(share) - 0.5 * (center * center / variance + torch.log(variance)).sum(dim=2, keepdim=True)
        member = torch.softmax(ways @ both + level, dim=1)
        sums = (member * weight) @ seen
        area = sums[..., 6:] + 1e-3
        center = (sums[..., :3] + 1e-3 * center) / area
        if step >= _ROUNDS[0]:
            variance = (sums[..., 3:6] / area - center * center).clamp(min=0) + _FINEST**2
        share = area / area.sum(dim=1, keepdim=True)
    return ColorMixture(center, variance, share)


def _drawn(color: Tensor, spread: Tensor, colors: ColorMixture) -> tuple[Tensor, Tensor]:
    """Expected true colors (B, 3, N) behind measured ones with variances `spread`, and membership (B, COLORS, N)."""
    difference = color[:, None] - colors.center[..., None]  # (B, COLORS, 3, N)
    wide = spread[:, None] + colors.variance[..., None]
    pull = difference / wide
    score = (difference * pull).sum(dim=2) + torch.log(wide.prod(dim=2))
    member = torch.softmax(torch.log(colors.share) - 0.5 * score, dim=1)
    return color - spread * (member[:, :, None] * pull).sum(dim=1), member


class ColorGloss(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """What each color of the picture says of its gloss: a correction (B, outputs, H, W) to a first reading."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        known = 2 * PROFILE + 7 + outputs
        self.read = nn.Sequential(
            nn.Linear(known, 256), nn.GELU(), nn.Linear(256, 256), nn.GELU(), nn.Linear(256, outputs)
        )
        nn.init.zeros_(self.read[-1].weight)
        nn.init.zeros_(self.read[-1].bias)

    def forward(self, seen: GlossEvidence, first: Tensor, member: Tensor, colors: ColorMixture) -> Tensor:
        """first (B, outputs, H, W): the reading that is corrected, before its sigmoids."""
        outputs = self.read(describe_colors(seen, first, member, colors))  # (B, COLORS, outputs)
        batch, _, height, width = member.shape
        return (outputs.transpose(1, 2) @ member.flatten(2)).reshape(batch, -1, height, width)


def describe_colors(seen: GlossEvidence, first: Tensor, member: Tensor, colors: ColorMixture) -> Tensor:
    """What is known of each color, (B, COLORS, ·).

    Its own profile and the whole object's, the color itself and beside the object's mean, its share, the mean of the
    first reading.
    """
    usable, figures, cosine = (part.flatten(2) for part in (seen.usable, seen.figures, seen.cosine))
    mine = member.flatten(2) * usable
    area = mine.sum(dim=2, keepdim=True)
    share = area / (area.sum(dim=1, keepdim=True) + 1e-3)
    center = colors.center @ usable.new_tensor(_AXES)  # logarithms of red, green, blue
    mean = (share * center).sum(dim=1, keepdim=True)
    whole = profile(usable, figures, cosine).expand(-1, COLORS, -1)
    said = (mine @ first.flatten(2).transpose(1, 2)) / (area + 1e-3)
    known = [profile(mine, figures, cosine), whole, center, center - mean, torch.log(share + 1e-3) / 3, said]
    return torch.cat(known, dim=2)
