"""Recurring colors of a picture in the main network: they correct uncertain albedos and estimate gloss by color.

An object has few colors, seen under many angles. Near the outline or under a wide highlight the albedo is uncertain; it
is probably one of the colors that are seen well elsewhere. A color without a highlight where it faces the flash is
rough, even next to a glossy print. The colors are a mixture of Gaussians, fitted to each picture; only their use is
learned.
"""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor, nn

from polcap.training.gloss_profiles import PROFILE, GlossEvidence, profile

COLORS = 8
_OFFSET = 0.02  # added to albedo before its logarithm
# lightness and two hues
_AXES = ((3**-0.5, 3**-0.5, 3**-0.5), (2**-0.5, -(2**-0.5), 0.0), (6**-0.5, 6**-0.5, -2 * 6**-0.5))
_KNOTS_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 65.0, 70.0, 75.0, 80.0, 90.0)  # zeniths
_LIGHT_DOUBT = (0.4, 0.35, 0.3, 0.2, 0.17, 0.17, 0.27, 0.37, 0.48, 0.6, 0.7, 0.8)  # initial 1σ of log lightness there
_HUE_DOUBT = 0.3  # initial 1σ of the hues, relative to that of the lightness
_CLIPPED = 0.5  # added to 1σ where the picture is clipped
_MAX_CHANGE = 3.0  # greatest change of the logarithm of 1σ
_CERTAIN = 0.2  # 1σ of lightness below which a pixel has full weight in the fit of the colors
_WIDTH = 0.2  # 1σ of all colors in the first rounds of the fit
_MIN_WIDTH = 0.05  # 1σ of a color
_ROUNDS = (5, 7)  # iterations of the fit: with one width, then with a width for each color


@dataclass(frozen=True)
class ColorMixture:
    """Recurring colors of B pictures as mixtures of Gaussians on the axes of `_opponent`; fields (B, COLORS, ·)."""

    center: Tensor  # 3
    variance: Tensor  # 3
    share: Tensor  # 1


class Recolor(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Network part that moves uncertain albedo towards the recurring colors of its picture."""

    def __init__(self) -> None:
        super().__init__()
        lightness = torch.log(torch.tensor(_LIGHT_DOUBT))
        hue = lightness + torch.log(torch.tensor(_HUE_DOUBT))
        self.knots = nn.Parameter(torch.stack([lightness, hue]))  # (2, n) ln of 1σ at n zenith angles

    def forward(
        self, diffuse: Tensor, doubt: Tensor, cosine: Tensor, inside: Tensor, clipped: Tensor
    ) -> tuple[Tensor, Tensor, ColorMixture]:
        """Correct uncertain albedo (B, 3, H, W) by the recurring colors of the picture.

        `doubt` (B, 2, H, W) is added to the log of the albedo's 1σ, which depends on the zenith, for lightness and for
        hue. `cosine` of the zenith, `inside` and `clipped` are (B, 1, H, W). Returns the albedo, each pixel's share in
        the colors (B, COLORS, H, W), and the colors.
        """
        color = _opponent(diffuse)
        expected = _interpolation_weights(cosine.flatten(2)) @ self.knots.T
        sigma = torch.exp(expected.transpose(1, 2).reshape(doubt.shape) + doubt.clamp(-_MAX_CHANGE, _MAX_CHANGE))
        weight = inside * (1 - clipped) * (_CERTAIN / sigma[:, :1]).square().clamp(max=1) + 1e-6
        colors = fit_mixture(*(part[:, :, ::2, ::2].flatten(2).detach() for part in (color, weight)))
        spread = (sigma + _CLIPPED * clipped)[:, [0, 1, 1]].square()
        corrected, member = _correct(color.flatten(2), spread.flatten(2), colors)
        axes = color.new_tensor(_AXES)
        out = (torch.exp(axes.T @ corrected) - _OFFSET).clamp(1e-3, 1.0)
        batch, _, height, width = diffuse.shape
        return out.reshape(batch, 3, height, width), member.reshape(batch, COLORS, height, width), colors


def _opponent(diffuse: Tensor) -> Tensor:
    """Logarithms of albedo (B, 3, H, W) on the axes of lightness and two hues."""
    return torch.einsum("ij,bjhw->bihw", diffuse.new_tensor(_AXES), torch.log(diffuse + _OFFSET))


def _interpolation_weights(cosine: Tensor) -> Tensor:
    """Weights (B, N, knots) of a curve's values at the angles _KNOTS_DEG, to interpolate it at cosines (B, 1, N)."""
    knots = cosine.new_tensor(_KNOTS_DEG)
    angle = (torch.acos(cosine.clamp(0, 1 - 1e-6)) * (180 / pi)).transpose(1, 2)
    steps = ((angle - knots[:-1]) / (knots[1:] - knots[:-1])).clamp(0, 1)  # 0…1 from each knot to the next
    one = torch.ones_like(angle)
    return torch.cat([one, steps], dim=2) - torch.cat([steps, 0 * one], dim=2)


@torch.no_grad()  # type: ignore[untyped-decorator]
def fit_mixture(color: Tensor, weight: Tensor) -> ColorMixture:
    """Fit a mixture to colors (B, 3, N) with weights (B, 1, N) by expectation-maximization.

    Centers start at the corners of the colors' spread. At first all have one width, so that centers of the same color
    meet; then each has its own.
    """
    total = weight.sum(dim=2, keepdim=True)
    mean = (color * weight).sum(dim=2, keepdim=True) / total
    spread = (((color - mean) ** 2 * weight).sum(dim=2, keepdim=True) / total).sqrt()
    corner = torch.cartesian_prod(*[color.new_tensor([-1.0, 1.0])] * 3)
    center = mean.transpose(1, 2) + corner * spread.transpose(1, 2)
    variance = torch.full_like(center, _WIDTH**2)
    share = torch.full_like(center[..., :1], 1 / COLORS)
    powers = torch.cat([color, color * color], dim=1)
    moments = torch.cat([powers, torch.ones_like(weight)], dim=1).transpose(1, 2)
    for step in range(sum(_ROUNDS)):
        slopes = torch.cat([center / variance, -0.5 / variance], dim=2)  # of the log density, over color and its square
        level = torch.log(share) - 0.5 * (center * center / variance + torch.log(variance)).sum(dim=2, keepdim=True)
        member = torch.softmax(slopes @ powers + level, dim=1)
        sums = (member * weight) @ moments
        area = sums[..., 6:] + 1e-3
        center = (sums[..., :3] + 1e-3 * center) / area  # a color without pixels stays
        if step >= _ROUNDS[0]:
            variance = (sums[..., 3:6] / area - center * center).clamp(min=0) + _MIN_WIDTH**2
        share = area / area.sum(dim=1, keepdim=True)
    return ColorMixture(center, variance, share)


def _correct(color: Tensor, spread: Tensor, colors: ColorMixture) -> tuple[Tensor, Tensor]:
    """Expected true colors (B, 3, N) of measured ones with variances `spread`; their membership (B, COLORS, N)."""
    difference = color[:, None] - colors.center[..., None]  # (B, COLORS, 3, N)
    variance = spread[:, None] + colors.variance[..., None]
    pull = difference / variance
    score = (difference * pull).sum(dim=2) + torch.log(variance.prod(dim=2))
    member = torch.softmax(torch.log(colors.share) - 0.5 * score, dim=1)
    return color - spread * (member[:, :, None] * pull).sum(dim=1), member


class ColorGloss(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Network part that corrects a first estimate of gloss (B, outputs, H, W) by color."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        features = 2 * PROFILE + 7 + outputs  # as `describe_colors` lists them
        self.read = nn.Sequential(
            nn.Linear(features, 256), nn.GELU(), nn.Linear(256, 256), nn.GELU(), nn.Linear(256, outputs)
        )
        nn.init.zeros_(self.read[-1].weight)
        nn.init.zeros_(self.read[-1].bias)

    def forward(self, seen: GlossEvidence, first: Tensor, member: Tensor, colors: ColorMixture) -> Tensor:
        """Correct a gloss estimate by recurring colors. first (B, outputs, H, W): the estimate before its sigmoids."""
        outputs = self.read(describe_colors(seen, first, member, colors))  # (B, COLORS, outputs)
        batch, _, height, width = member.shape
        return (outputs.transpose(1, 2) @ member.flatten(2)).reshape(batch, -1, height, width)


def describe_colors(seen: GlossEvidence, first: Tensor, member: Tensor, colors: ColorMixture) -> Tensor:
    """Features (B, COLORS, ·) from which the gloss of each recurring color is estimated.

    They are the gloss profiles of the color and of the whole object; the color, also relative to the object's mean; its
    share; the mean of the first estimate.
    """
    usable, figures, cosine = (part.flatten(2) for part in (seen.usable, seen.figures, seen.cosine))
    own = member.flatten(2) * usable
    area = own.sum(dim=2, keepdim=True)
    share = area / (area.sum(dim=1, keepdim=True) + 1e-3)
    center = colors.center @ usable.new_tensor(_AXES)  # logarithms of red, green, blue
    mean = (share * center).sum(dim=1, keepdim=True)
    object_profile = profile(usable, figures, cosine).expand(-1, COLORS, -1)
    estimate = (own @ first.flatten(2).transpose(1, 2)) / (area + 1e-3)
    own_profile = profile(own, figures, cosine)
    return torch.cat([own_profile, object_profile, center, center - mean, torch.log(share + 1e-3) / 3, estimate], dim=2)
