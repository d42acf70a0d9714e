"""Recurring colors of a picture are found, correct uncertain albedo, and are described for the gloss estimate."""

import torch

from polcap.training import gloss_profiles, recurring_colors

RED, BLUE = (0.6, 0.1, 0.1), (0.1, 0.1, 0.6)


def print_of(colors: list[tuple[float, float, float]], side: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """A print (1, 3, H, W) of squares in these colors, 5 % uneven, and the number of each pixel's color (H, W)."""
    torch.manual_seed(0)
    square = torch.arange(side) // 3
    which = (square[:, None] + square) % len(colors)
    even = torch.tensor(colors)[which].permute(2, 0, 1)[None]
    return even * torch.exp(0.05 * torch.randn(1, 1, side, side)), which


def found(picture: torch.Tensor) -> recurring_colors.ColorMixture:
    color = recurring_colors._opponent(picture).flatten(2)
    return recurring_colors.fit_mixture(color, torch.ones_like(color[:, :1]))


def albedo(colors: recurring_colors.ColorMixture) -> torch.Tensor:
    """(COLORS, 3)"""
    return torch.exp(colors.center[0] @ torch.tensor(recurring_colors._AXES)) - recurring_colors._OFFSET


def recolored(
    picture: torch.Tensor, cosine: float | torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, recurring_colors.ColorMixture]:
    """Output of `Recolor` for the expected uncertainty at this zenith; all pixels are inside and unclipped."""
    one = torch.ones_like(picture[:, :1])
    none = torch.zeros(1, 2, *picture.shape[2:])
    with torch.no_grad():
        return recurring_colors.Recolor()(picture, none, one * cosine, one, 0 * one)


def test_the_colors_of_a_print_are_found() -> None:
    colors = [(0.6, 0.6, 0.6), (0.3, 0.3, 0.3), (0.6, 0.05, 0.05)]  # two greys and a red
    mixture = found(print_of(colors)[0])
    for color in colors:
        near = (albedo(mixture) / torch.tensor(color)).log().abs().amax(dim=1) < 0.05
        assert abs(float(mixture.share[0, near].sum()) - 1 / 3) < 0.02


def test_one_color_is_found_once() -> None:
    centers = found(print_of([(0.5, 0.4, 0.3)])[0]).center[0]
    assert (centers.amax(dim=0) - centers.amin(dim=0)).max() < 0.05


def test_uncertain_albedo_moves_to_a_color_seen_well() -> None:
    """A third of the pixels, steeply tilted, are 40 % too dark; their hue identifies the color."""
    truth, which = print_of([RED, BLUE])
    steep = torch.arange(which.numel()).reshape(which.shape) % 24 < 8
    seen = torch.where(steep, 0.6 * truth, truth)
    cosine = torch.where(steep, 0.2, 0.8)[None, None]
    got = recolored(seen, cosine)[0]
    before, after = ((x / truth).log().abs()[0].mean(dim=0) for x in (seen, got))
    assert after[steep].mean() < 0.3 * before[steep].mean()
    assert after[~steep].mean() < 0.06
    assert (got / truth).log().abs()[..., steep].mean() < 0.15  # in every channel: no red has become blue


def test_well_seen_shades_are_preserved() -> None:
    """A gradient of three stops from dark to light stays smooth."""
    run = torch.exp(torch.linspace(-2.5, -0.4, 64 * 64)).reshape(1, 1, 64, 64).expand(1, 3, 64, 64)
    assert (recolored(run, 0.8)[0] / run).log().abs().max() < 0.15


def test_uncertainty_is_interpolated_between_its_knots() -> None:
    knots = torch.tensor(recurring_colors._KNOTS_DEG)
    at = torch.deg2rad(torch.cat([knots, torch.tensor([35.0])]))
    weights = recurring_colors._interpolation_weights(torch.cos(at).view(1, 1, -1))[0]
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(len(at)))
    torch.testing.assert_close(weights @ knots, torch.rad2deg(at), atol=0.1, rtol=0)
    assert abs(float(weights[-1, 3]) - 0.5) < 0.01


def test_each_color_is_described_by_its_own_light() -> None:
    picture, which = print_of([RED, BLUE])
    red = (which == 0)[None, None].float()
    zenith, one = torch.rand_like(red), torch.ones_like(red)
    figures, first = torch.rand(2, 1, 5, *which.shape)
    _, member, colors = recolored(picture, 0.8)

    def known(light: torch.Tensor) -> torch.Tensor:
        return recurring_colors.describe_colors(
            gloss_profiles.GlossEvidence(light, zenith, picture, one), first, member, colors
        )

    moved = (known(figures + red) - known(figures))[0, :, : gloss_profiles.PROFILE].abs().amax(dim=1)
    of_red = (member[0].flatten(1) @ red.flatten()) / member[0].flatten(1).sum(dim=1)
    assert moved[of_red > 0.9].min() > 0.1
    assert moved[of_red < 0.1].max() < 0.05
