"""Light over zenith: what the profile says is what was rendered."""

import numpy as np
import torch

from polcap.optics import brdf, fresnel, shade
from polcap.stages.cues import NOMINAL_IOR
from polcap.training import profiles

DIFFUSE, F0, ROUGHNESS = 0.4, 0.06, 0.5


def ball(side: int = 96) -> tuple[torch.Tensor, torch.Tensor]:
    """Normals (1, 3, H, W) of a sphere seen along the axis, and its mask (1, 1, H, W)."""
    x = torch.linspace(-1, 1, side)
    y, x = torch.meshgrid(x, x, indexing="ij")
    z = (1 - x * x - y * y).clamp(min=0).sqrt()
    return torch.stack([x, y, z])[None], (z > 0.05).float()[None, None]


def profile(specular: float) -> torch.Tensor:
    """(bins, figures) of the ball as one group."""
    normal, inside = ball()
    flat = normal[0].permute(1, 2, 0)
    one = torch.ones(flat.shape[:2])
    light = torch.zeros_like(flat) + torch.tensor([0.0, 0, 1])
    white = torch.ones_like(flat)
    stokes = shade.stokes(flat, DIFFUSE * white, specular * white, ROUGHNESS * one, NOMINAL_IOR * one, light, one)
    level = torch.log(stokes[0] + 0.02).permute(2, 0, 1)[None]
    ratio = (stokes[1:].sum(-1) / stokes[0].sum(-1).clamp(min=1e-6))[None]
    figures = profiles.figures_of(level, ratio, normal, torch.full_like(normal, DIFFUSE))
    table = profiles._profile(inside.flatten(2), (figures * inside).flatten(2), normal[:, 2:].flatten(2))
    return table.reshape(profiles._BINS, profiles._FIGURES)


def test_a_matte_ball_has_no_excess_and_its_whole_polarization() -> None:
    table = profile(0.0)
    assert table[:8, 2].abs().max() < 0.05  # excess
    assert table[7:, 5].abs().max() < 0.12  # missing DoLP, where there is any to miss


def test_the_excess_at_the_pole_is_the_lobe() -> None:
    """ln(1 + F0 π D G/(4 cos) / (ρ cos T₊²)) at normal incidence, from the textbook formulas alone."""
    alpha = ROUGHNESS**2
    lobe = np.pi * (1 / (np.pi * alpha**2)) / 4
    body = DIFFUSE * 0.96**2
    expected = np.log(1 + F0 * lobe / body)
    assert abs(brdf.ggx_distribution(1.0, alpha) * np.pi / 4 - lobe) < 1e-9 * lobe
    assert abs(fresnel.transmission(1.0, NOMINAL_IOR)[0] - 0.96) < 1e-6
    found = profile(F0)[:, 2]
    assert abs(float(found[0]) - expected) < 0.15 * expected  # the bin reaches to 4°, where the lobe has fallen
    assert float(found[0]) > float(found[1]) > float(found[2]) > float(found[4])


def test_groups_by_color_hold_one_color_each_and_the_whole_object() -> None:
    torch.manual_seed(0)
    colors = torch.tensor([[0.5, 0.1, 0.1], [0.1, 0.1, 0.5], [0.45, 0.45, 0.4]])
    which = (torch.arange(64)[:, None] // 8 + torch.arange(64)[None] // 8) % 3
    diffuse = (colors[which] * torch.exp(0.04 * torch.randn(64, 64, 3))).permute(2, 0, 1)[None]
    inside = torch.zeros(1, 1, 64, 64)
    inside[..., 8:56, 8:56] = 1
    diffuse = torch.where(inside > 0, diffuse, torch.rand(1, 3, 64, 64))  # what is beside it is not asked
    member = profiles.by_color(diffuse, inside)
    assert torch.allclose(member.sum(dim=1), torch.ones(1, 64, 64), atol=1e-5)
    share = torch.stack([member[0, :, (which == k) & (inside[0, 0] > 0)].mean(dim=1) for k in range(3)])
    purity = share.max(dim=0).values.sum() / share.sum()
    print(f"groups' purity {float(purity):.3f}")
    assert purity > 0.95


def test_profiles_of_colors_tell_the_gloss_of_each() -> None:
    """A ball of two colors in stripes, one glossy: only the glossy color's group shows an excess at the pole."""
    normal, inside = ball()
    flat = normal[0].permute(1, 2, 0)
    stripe = (torch.arange(96) // 6 % 2 == 0)[:, None].expand(96, 96)
    one, up = torch.ones(96, 96), torch.zeros_like(flat) + torch.tensor([0.0, 0, 1])
    diffuse = torch.where(stripe[..., None], torch.tensor([0.4, 0.2, 0.2]), torch.tensor([0.2, 0.2, 0.4]))
    specular = torch.where(stripe, F0, 0.0)[..., None].expand(96, 96, 3)
    stokes = shade.stokes(flat, diffuse, specular, ROUGHNESS * one, NOMINAL_IOR * one, up, one)
    level = torch.log(stokes[0] + 0.02).permute(2, 0, 1)[None]
    ratio = (stokes[1:].sum(-1) / stokes[0].sum(-1).clamp(min=1e-6))[None]
    picture = diffuse.permute(2, 0, 1)[None]
    figures = profiles.figures_of(level, ratio, normal, picture)
    member = profiles.by_color(picture, inside)
    heard: list[torch.Tensor] = []
    reader = profiles.ColorProfiles(2)
    reader.read[0].register_forward_pre_hook(lambda _, given: heard.append(given[0]))
    assert reader(member, figures * inside, normal[:, 2:], inside).abs().max() == 0  # silent until it has learned
    excess = heard[0][0].reshape(-1, profiles._BINS, profiles._FIGURES)[:, 0, 2]
    within = (member * inside)[0]
    share = (within * stripe).sum(dim=(1, 2)) / within.sum(dim=(1, 2))  # glossy part of each group
    assert excess[share > 0.97].min() > 0.15 > 0.03 > excess[share < 0.03].max()
