"""Random materials are within their bounds, and as correlated as real ones."""

import torch

from polcap.training import materials

OBJECTS, PLACES = 150, 1500


OWNER = torch.arange(OBJECTS).repeat_interleave(PLACES)


def draw_spheres(hidden: torch.Tensor | None = None) -> tuple[materials.Surface, torch.Tensor]:
    """Spheres in random materials of solid noise, and their own normals."""
    torch.manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(OBJECTS * PLACES, 3), dim=1)
    library, turn = materials.MaterialLibrary(None, torch.device("cpu")), torch.eye(3).expand(OBJECTS, 3, 3)
    return materials.draw_surface(library, normal, normal / 2, turn, OWNER, hidden=hidden), normal


def test_materials_stay_within_their_bounds() -> None:
    surface, normal = draw_spheres()
    assert surface.diffuse.min() >= 0.005 and surface.diffuse.max() <= 0.95
    assert surface.specular.min() >= 0.015 and surface.specular.max() <= 0.4
    assert surface.roughness.min() >= 0.05 and surface.roughness.max() <= 1
    assert surface.ior.min() >= 1.35 and surface.ior.max() <= 1.7
    tilt = torch.rad2deg(torch.acos((surface.normal * normal).sum(dim=1).clamp(-1, 1))).view(OBJECTS, PLACES)
    assert tilt.mean(dim=1).median() < 5 < tilt.max() < 60


def test_levels_spread_between_objects_and_gloss_follows_the_pattern_on_many() -> None:
    surface, _ = draw_spheres()
    rough, f0 = surface.roughness.view(OBJECTS, PLACES), surface.specular.mean(dim=1).view(OBJECTS, PLACES)
    light = surface.diffuse.mean(dim=1).log().view(OBJECTS, PLACES)
    assert rough.mean(dim=1).std() > 0.12 and f0.mean(dim=1).std() > 0.015
    together = torch.stack([torch.corrcoef(torch.stack(pair))[0, 1] for pair in zip(rough, light)]).abs()
    assert 0.3 < (together > 0.5).float().mean() < 0.9  # many patterns are two surfaces, not all


def test_some_colors_leave_a_channel_dark_and_most_do_not() -> None:
    colors = materials._colors((2000, 3), torch.device("cpu")).reshape(-1, 3)
    purity = colors.amin(dim=1) / colors.amax(dim=1)
    assert 0.02 < (purity < 0.05).float().mean() < 0.15 and (purity > 0.5).float().mean() > 0.4
    assert colors.min() >= 0.01 and colors.max() <= 0.95


def test_an_eighth_of_all_objects_is_dark_gloss_everywhere_or_for_the_most_part() -> None:
    surface, _ = draw_spheres()
    albedo = surface.diffuse.mean(dim=1).view(OBJECTS, PLACES)
    dark = (albedo < 0.08) & (surface.roughness.view(OBJECTS, PLACES) < 0.4)
    share = dark.float().mean(dim=1)
    assert 0.07 < (share > 0.9).float().mean() < 0.2
    assert ((share > 0.1) & (share < 0.9)).float().mean() > 0.02
    whole = (share > 0.9)[:, None] & dark
    assert 0.035 < surface.specular.mean(dim=1).view(OBJECTS, PLACES)[whole].median() < 0.05


def test_some_patterns_follow_hollows_and_bands_and_sides() -> None:
    """Each kind of shape pattern is a function of the shape alone."""
    place = torch.nn.functional.normalize(torch.randn(OBJECTS * PLACES, 3), dim=1)
    hidden = (place[:, 2] < 0).float()
    form = materials._draw_form(place / 2, place, hidden, OWNER, OBJECTS).view(OBJECTS, PLACES)
    assert form.min() >= -1 and form.max() <= 1
    levels = torch.tensor([len(one.unique()) for one in form])
    hollows = levels == 2
    assert 0.2 < hollows.float().mean() < 0.5  # a third
    sides = torch.stack([(form[:, None] - place.view(OBJECTS, PLACES, 3).transpose(1, 2)).abs().amax(dim=2)])
    assert 0.2 < (sides.amin(dim=(0, 2)) < 1e-6).float().mean() < 0.5


def test_gloss_and_albedo_follow_the_hollows_of_some_objects() -> None:
    hidden = (torch.rand(OBJECTS * PLACES) < 0.5).float()  # unrelated to the noise in space
    correlation = []
    for seen in (hidden, None):
        surface, _ = draw_spheres(seen)
        albedo = surface.diffuse.mean(dim=1).view(OBJECTS, PLACES)
        pairs = zip(albedo, hidden.view(OBJECTS, PLACES))
        correlation.append(torch.stack([torch.corrcoef(torch.stack(pair))[0, 1] for pair in pairs]).abs())
    assert 0.04 < (correlation[0] > 0.3).float().mean() < 0.3
    assert (correlation[1] > 0.15).float().mean() < 0.01
