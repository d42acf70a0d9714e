"""Random gloss of the training materials: roughness and F0 by families, and the polarization of diffuse light.

A family is drawn for each surface: a print and its paper are two. F0 is mostly that of plastics, paints, glazes,
paper, wood, stone and cloth; some glossy surfaces have the higher F0 of coatings and gems.

References
----------
Akenine-Möller et al., Real-time rendering, 4th ed. 2018, table 9.2: F0 of dielectrics: plastics and glass .04–.05,
fabric .04–.056, stone .035–.056, gems .05–.08, diamond-like .13–.2, water .02.
Burley, Physically-based shading at Disney, SIGGRAPH 2012 course: F0 .00–.08 covers common materials; roughness of the
measured MERL materials by kind.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from polcap.optics.body import Law


@dataclass(frozen=True)
class GlossFamily:
    """Distribution of the gloss of one kind of surface."""

    share: float  # of surfaces
    roughness: tuple[float, float]  # perceptual, uniform between these
    tail: float  # share with an F0 above common dielectrics
    dolp_factor: tuple[float, float] = (1.0, 1.0)  # factor on the polarization of diffuse light
    grain: float = 0.5  # share with speckled gloss
    dark: bool = False  # hardly any diffuse reflection: most light is mirrored from other parts of the object


FAMILIES = {
    "glossy": GlossFamily(0.25, (0.10, 0.35), 0.40),  # plastics, glazes, varnish
    "satin": GlossFamily(0.27, (0.28, 0.60), 0.28),  # paints, leather, waxed wood
    "matte": GlossFamily(0.27, (0.50, 0.95), 0.08),  # plaster, clay, paper, stone
    "brushed": GlossFamily(0.08, (0.25, 0.65), 0.30, grain=1.0),  # sanded, scratched, grained
    "fibrous": GlossFamily(0.08, (0.65, 1.00), 0.00, dolp_factor=(0.3, 0.9), grain=1.0),  # cloth, felt, unsized paper
    "dark gloss": GlossFamily(0.05, (0.05, 0.30), 0.00, dark=True),  # black plastic, lacquer, leather, dark glaze
}
ALL_DARK = 0.10  # share of objects that are dark gloss everywhere; other objects may have dark parts
_DARK = (0.01, 0.06)  # albedo
_F0, _F0_SPREAD = 0.042, 0.13  # median and 1σ of the logarithm for common dielectrics, n = 1.45–1.58
_TAIL = (0.055, 1.5)  # higher F0: the least, and ln(greatest / least); low values are more frequent
SMOOTH_SHARE = 0.5  # share of objects with a smooth interface for diffuse light
_SAME_ROUGHNESS = 0.6  # share of rough interfaces with one roughness for gloss and diffuse light; coated ones have two
_TRANSLUCENT = 0.08  # share of rough interfaces that are translucent, so that diffuse light is depolarized


@dataclass(frozen=True)
class Gloss:
    """Random gloss of training surfaces; all fields have one shape."""

    roughness: Tensor
    f0: Tensor
    dolp_factor: Tensor  # factor on the polarization of diffuse light
    grained: Tensor  # bool
    dark: Tensor  # bool


def dark_albedo(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Draw nearly gray, dark albedos (*shape, 3), as of black plastic or lacquer."""
    low, high = _DARK
    value = low * (high / low) ** torch.rand((*shape, 1), device=device)
    return value * torch.exp(0.15 * torch.randn((*shape, 3), device=device))


def draw_gloss(all_dark: Tensor, shape: tuple[int, ...]) -> Gloss:
    """Draw a random gloss family for each surface, and values from it; where `all_dark` is true, dark gloss.

    All fields have the shape `shape`, to which `all_dark` broadcasts.
    """
    device = all_dark.device
    share = torch.tensor([family.share for family in FAMILIES.values()], device=device)
    which = torch.multinomial(share, torch.Size(shape).numel(), replacement=True).reshape(shape)
    which = torch.where(all_dark, list(FAMILIES).index("dark gloss"), which)

    def u() -> Tensor:
        return torch.rand(shape, device=device)

    def of(name: str) -> Tensor:
        return torch.tensor([getattr(family, name) for family in FAMILIES.values()], device=device)[which]

    low, high = of("roughness").unbind(dim=-1)
    least, most = of("dolp_factor").unbind(dim=-1)
    common = (_F0 * torch.exp(_F0_SPREAD * torch.randn(shape, device=device))).clamp(0.028, 0.06)
    rare = _TAIL[0] * torch.exp(_TAIL[1] * u() ** 1.5)
    return Gloss(
        roughness=low + (high - low) * u(),
        f0=torch.where(u() < of("tail"), rare, common),
        dolp_factor=least + (most - least) * u(),
        grained=u() < of("grain"),
        dark=of("dark"),
    )


def draw_laws(count: int, device: torch.device, smooth_share: float = SMOOTH_SHARE) -> Law:
    """Draw the parameters of diffuse polarization for `count` objects, (B,): a smooth interface or rough facets.

    The path of light inside a body is not known. So rough interfaces have either weighting of facets or one between
    them, and a factor of 0.8–1 on the polarization, less for translucent ones.
    """

    def u(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, device=device)

    rough = (u(0, 1) >= smooth_share).float()
    other = torch.exp(0.25 * torch.randn(count, device=device)).clamp(0.5, 1.6)
    scale = torch.where(u(0, 1) < _SAME_ROUGHNESS, torch.ones(count, device=device), other)
    local = u(-1, 2).clamp(0, 1)  # a third each: 0, 1, between
    dolp_factor = torch.where(u(0, 1) < _TRANSLUCENT, u(0.25, 0.8), u(0.8, 1.0))
    return Law(rough * scale, rough * local, 1 - rough * (1 - dolp_factor))
