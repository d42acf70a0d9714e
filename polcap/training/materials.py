"""Random materials for training: diffuse, specular, roughness, refractive index and bumped normals of each pixel.

Functions take flat lists of the object's pixels (M, ·), because two thirds of a view are background. An object has one
to three materials in regions of solid noise. The pattern of a material comes from a texture set, projected along the
nearest axis, or from solid noise. Every second object's patterns lie along its own axes. Some regions and patterns
belong to the shape: dirt in hollows, bands along an axis, sides in other colors. F0 and roughness follow the pattern of
the albedo, as in real materials, about levels drawn per material. Many patterns mix two surfaces, as print, glaze,
inlay and wear do: two glosses a few pixels from each other, often in relief. `gloss.py` draws gloss and diffuse
polarization.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from polcap.formats import scene_files
from polcap.optics import frames, shade
from polcap.optics.body import SMOOTH, Law
from polcap.training import gloss

_MATERIALS = 3  # slots per object
_SIDE = 48  # of the noise volume, cells
_TEXELS = 256  # side of a texture
_ALIGNED = 0.5  # share of objects whose patterns lie along the object's axes, as prints and weave do
_LIGHTNESS = 0.45  # exponent from reflectance to lightness, about 1/2.2 as on a display
_OF_SHAPE = 0.25  # share of objects whose regions follow their shape, and of those whose patterns do


@dataclass(frozen=True)
class Surface:
    """Normals and material of an object's surface at M pixels; camera frame."""

    normal: Tensor  # (M, 3) with bumps
    diffuse: Tensor  # (M, 3)
    specular: Tensor  # (M, 3) F0
    roughness: Tensor  # (M,)
    ior: Tensor  # (M,)
    law: Law = SMOOTH  # (M,) diffuse polarization


def reflect(surface: Surface, v: Tensor, to_flash: Tensor, strength: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normals (M, 3) in the frames of rays v, and Stokes parameters (3, M, 3) of diffuse and of specular reflection.

    to_flash (M, 3), camera frame; strength (M,): S0 of a white plane that faces the flash at distance 1.
    """
    normal = frames.lifted(frames.to_ray_frame(surface.normal, v))
    squared = (to_flash * to_flash).sum(dim=1)
    direction = frames.to_ray_frame(to_flash / squared.sqrt()[:, None], v)
    nothing, lit = torch.zeros_like(surface.specular), (surface.roughness, surface.ior, direction, strength / squared)
    diffuse = shade.stokes(normal, surface.diffuse, nothing, *lit, surface.law)
    return normal, diffuse, shade.stokes(normal, nothing, surface.specular, *lit)


class MaterialLibrary:
    """Texture sets of a folder, if it exists, and a volume of tileable noise, on one device."""

    def __init__(self, folder: Path | None, device: torch.device, seed: int = 3) -> None:
        sets = sorted(p.parent for p in folder.glob("*/albedo.jpg")) if folder else []
        self.names = [p.name for p in sets]
        stack = [scene_files.read_textures(p, _TEXELS) for p in sets]
        stack = stack or [np.full((6, _TEXELS, _TEXELS), 0.5, dtype=np.float32)]
        self.texture = torch.from_numpy(np.stack(stack, axis=1)).to(device)[None]  # (1, 6, T, 256, 256)
        self.has_textures = bool(sets)
        lightness = self.texture[0, :3].mean(dim=0).flatten(1) ** _LIGHTNESS  # (T, texels)
        self.middle, self.spread = lightness.mean(dim=1), lightness.std(dim=1) + 0.02
        self.noise = _noise_volume(seed).to(device)  # (1, 7, D, D, D)

    def sample_textures(self, which: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """Sample texture sets at coordinates u, v (M,), mirrored at odd integers: (M, 6).

        The six values are albedo (3), roughness, slope along u, slope along v. `which` (M,) is the number of the set.
        """
        count = self.texture.shape[2]
        slot = which.float() * (2.0 / max(count - 1, 1)) - 1.0
        grid = torch.stack([_mirror(u), _mirror(v), slot], dim=-1)[None, None, None]
        sampled = F.grid_sample(self.texture, grid, mode="bilinear", padding_mode="border", align_corners=True)
        return sampled[0, :, 0, 0].T

    def sample_noise(self, position: Tensor) -> Tensor:
        """Sample the noise volume at positions: (M, 7), four noises of variance 1, then the gradient of the fourth."""
        grid = _mirror(position)[None, None, None]
        return F.grid_sample(self.noise, grid, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0, 0].T


def draw_surface(
    library: MaterialLibrary, normal: Tensor, position: Tensor, turn: Tensor, owner: Tensor,
    smooth_share: float = gloss.SMOOTH_SHARE, hidden: Tensor | None = None,
) -> Surface:  # fmt: skip
    """Draw a material for each of B objects and evaluate it at their M pixels.

    normal (M, 3) camera frame, position (M, 3) object frame, turn (B, 3, 3) from object to camera, owner (M,) the
    object of each pixel; smooth_share: of objects with a smooth interface (`optics/body.py`); hidden (M,): how far the
    object itself surrounds each pixel, 0…1.
    """
    count, device = len(turn), normal.device
    # position and normal in the frame of the patterns
    frame, _ = torch.linalg.qr(torch.randn(count, 3, 3, device=device))  # from object to pattern
    aligned = (_u((count, 1, 1), device) < _ALIGNED).to(frame.dtype)
    frame = aligned * torch.eye(3, device=device) + (1 - aligned) * frame
    place = _rotate(frame, position, owner)
    facing = _rotate(frame @ turn.transpose(1, 2), normal, owner)
    # noise that divides an object into materials, of the relief, and of printed patterns; some follow the shape
    regions, fine, printed = (
        library.sample_noise(place * _log_uniform((count, 1), low, high, device)[owner] + _u((count, 3), device)[owner])
        for low, high in ((0.5, 2.5), (2.0, 9.0), (4.0, 28.0))
    )
    outward = _rotate(turn.transpose(1, 2), normal, owner)
    form = _draw_form(position, outward, torch.zeros_like(owner) if hidden is None else hidden, owner, count)
    of_shape = (_u((2, count), device) < _OF_SHAPE) * (0.5 + 2 * _u((2, count), device))  # of regions, of patterns
    regions[:, 0] += of_shape[0, owner] * form
    printed[:, 0] += of_shape[1, owner] * form
    # material of each pixel: of the slots that its object uses, the one with the greatest noise
    used = 1 + torch.bucketize(_u((count,), device), torch.tensor([0.5, 0.85], device=device))  # mostly one or two
    active = torch.arange(_MATERIALS, device=device)[None] < used[:, None]
    slot = torch.where(active[owner], regions[:, :_MATERIALS], -9.0).argmax(dim=1)
    row = owner * _MATERIALS + slot
    levels = _draw_levels(library, count, device)
    own = {name: value.reshape(count * _MATERIALS, -1)[row].squeeze(-1) for name, value in levels.items()}
    # texture, projected along the nearest axis
    axis = facing.abs().argmax(dim=1)
    across, up = ((axis + step) % 3 for step in (1, 2))
    scale = _log_uniform((count,), 0.4, 3.0, device)[owner]
    u = place.gather(1, across[:, None])[:, 0] * scale + own["shift"]
    v = place.gather(1, up[:, None])[:, 0] * scale
    texture = own["texture"].long()
    picture = library.sample_textures(texture, u, v)
    lightness = (picture[:, :3].mean(dim=1) ** _LIGHTNESS - library.middle[texture]) / library.spread[texture]
    # albedo and gloss
    pattern, diffuse = _albedo(own, fine, printed, picture, lightness)
    rough, specular = _reflection(own, fine, picture, pattern, diffuse)
    law = gloss.draw_laws(count, device, smooth_share).at(owner)
    fibers = torch.where(law.rough > 0, own["dolp_factor"] + own["dolp_step"] * pattern, 1.0)
    law = Law(law.rough, law.local, law.dolp_factor * fibers)
    # bumps, with the slopes of the noise or of the texture
    relief = fine[:, 4:7] * torch.where(own["raised"] > 0.5, 4 * pattern * (1 - pattern), 1.0)[:, None]
    slope = torch.zeros_like(facing).scatter(1, across[:, None], picture[:, 4:5])
    slope = slope.scatter(1, up[:, None], picture[:, 5:6])
    slope = torch.where((own["from_texture"] > 0.5)[:, None], slope, relief)  # in the pattern's frame
    slope = _rotate(turn, _rotate(frame.transpose(1, 2), slope, owner), owner)
    along = (slope * normal).sum(dim=1, keepdim=True)
    bumped = F.normalize(normal + own["bump"][:, None] * (slope - along * normal), dim=1)
    return Surface(bumped, diffuse, specular, rough, own["ior"], law)


def _draw_form(position: Tensor, outward: Tensor, hidden: Tensor, owner: Tensor, count: int) -> Tensor:
    """Values (M,) of about −1…1 that follow the shape of each object: hollows, bands along an axis, or its sides.

    Position and outward normal (M, 3) are in the object's frame; hidden (M,) as in `draw_surface`.
    """
    device = position.device
    kind, axis = torch.randint(3, (count,), device=device), torch.randint(3, (count, 1), device=device)
    frequency, phase = _log_uniform((count,), 2.0, 25.0, device), 2 * math.pi * _u((count,), device)
    along, side = (vector.gather(1, axis[owner])[:, 0] for vector in (position, outward))
    bands = torch.cos(frequency[owner] * along + phase[owner])
    choices = torch.stack([(3 * hidden).clamp(max=2) - 1, bands, side])
    return choices.gather(0, kind[owner][None])[0]


def _albedo(
    own: dict[str, Tensor], fine: Tensor, printed: Tensor, picture: Tensor, lightness: Tensor
) -> tuple[Tensor, Tensor]:
    """Pattern (M,) 0…1 that mixes two surfaces, and diffuse albedo (M, 3), of a drawn material.

    `own` chooses the source of the pattern: the noise `fine` of the relief, the noise `printed`, or the `lightness` of
    the texture `picture`. It also chooses whether the albedo is mixed from two colors or taken from the texture.
    """
    noise = torch.where(own["raised"] > 0.5, fine[:, 3], printed[:, 0])
    pattern = torch.sigmoid(own["contrast"] * (noise + own["level"]))
    painted = own["color"] * (1 - pattern[:, None]) + own["color2"] * pattern[:, None]
    textured = own["from_texture"] > 0.5
    by_lightness = textured & (own["by_lightness"] > 0.5)
    pattern = torch.where(by_lightness, torch.sigmoid(own["contrast"] * (lightness + 0.5 * own["level"])), pattern)
    return pattern, torch.where(textured[:, None], picture[:, :3] * own["tint"], painted).clamp(0.005, 0.95)


def _reflection(
    own: dict[str, Tensor], fine: Tensor, picture: Tensor, pattern: Tensor, diffuse: Tensor
) -> tuple[Tensor, Tensor]:
    """Roughness (M,) and F0 (M, 3) of a drawn material: its levels, varied with pattern, lightness and speckles."""
    lightness = diffuse.mean(dim=1) ** _LIGHTNESS
    deviation = (lightness - own["mid"]) * own["follow"] + 0.5 * own["speckle"] * fine[:, 1]
    from_texture = picture[:, 3] * own["rough_gain"] + own["rough_shift"]
    rough = torch.where(own["from_texture"] > 0.5, from_texture, own["rough"] + deviation)
    rough = rough + own["rough_step"] * pattern
    reflectance = own["f0"] * (1 + own["f0_follow"] * (lightness - own["mid"]) + own["speckle"] * fine[:, 2])
    reflectance = reflectance * torch.exp(own["f0_step"] * pattern)
    return rough.clamp(0.05, 1.0), (reflectance[:, None] * own["f0_tint"]).clamp(0.015, 0.4)


def _draw_levels(library: MaterialLibrary, count: int, device: torch.device) -> dict[str, Tensor]:
    """Draw the parameters of each material of each object, by name, (B, 3, ·)."""
    shape = (count, _MATERIALS)

    def u(low: float, high: float) -> Tensor:
        return low + (high - low) * _u(shape, device)

    def normal(deviation: float) -> Tensor:
        return deviation * torch.randn(shape, device=device)

    all_dark = (_u((count,), device) < gloss.ALL_DARK)[:, None]
    one, other = (gloss.draw_gloss(all_dark, shape) for _ in range(2))
    two_surfaces = u(0, 1) < 0.8  # else the pattern changes only the albedo
    similar_f0 = u(0, 1) < 0.5
    f0_step = torch.where(similar_f0, normal(0.2), torch.log(other.f0 / one.f0))
    as_is = u(0, 1) < 0.5  # roughness is that of the texture set
    color, color2 = _colors(shape, device), _colors(shape, device)
    same_hue = (u(0, 1) < 0.5)[..., None]
    color2 = torch.where(same_hue, color * (0.4 + 1.2 * _u((*shape, 1), device)), color2)
    tint = torch.exp(normal(0.4))[..., None] * torch.exp(0.15 * torch.randn((*shape, 3), device=device))
    texture = torch.randint(0, max(len(library.names), 1), shape, device=device)
    black = gloss.dark_albedo(shape, device)
    color = torch.where(one.dark[..., None], black, color)
    color2 = torch.where(other.dark[..., None], gloss.dark_albedo(shape, device), color2)
    tint = torch.where(one.dark[..., None], black / library.middle[texture][..., None] ** (1 / _LIGHTNESS), tint)
    from_texture = (u(0, 1) < 0.4) if library.has_textures else torch.zeros(shape, device=device)
    tinted = (one.f0 > 0.08) & (u(0, 1) < 0.3)
    f0_tint = torch.where(tinted[..., None], 1 + 0.4 * (_u((*shape, 3), device) - 0.5), torch.ones(1, device=device))
    # slopes of solid noise have a standard deviation of 1, textures are flatter, so theirs are raised; 14° at most
    bump = 0.25 * torch.exp(u(-3, 0)) * torch.sign(u(-1, 1)) * (u(0, 1) < 0.7)
    bump = bump * torch.where(from_texture > 0.5, 2.5, 1.0)
    return {
        "color": color, "color2": color2,  # albedo of the two surfaces of a pattern
        "tint": tint, "f0_tint": f0_tint,  # factors on the texture's albedo, on F0
        "from_texture": from_texture.float(),  # 1: albedo, roughness and slopes of a texture set, else solid noise
        "texture": texture.float(), "shift": u(0, 2),  # number of the set, and its shift
        "contrast": torch.exp(u(-0.5, 3.2)), "level": u(-1.5, 1.5),  # of the noise in the pattern
        "mid": color.mean(dim=-1) ** _LIGHTNESS,  # mean lightness
        "rough": one.roughness, "follow": normal(0.3),  # roughness, and its change with lightness
        "speckle": u(0, 0.25) * one.grained,  # contrast of fine noise in roughness and F0
        # of a texture's roughness
        "rough_gain": torch.where(one.dark, 0.1, torch.where(as_is, 1.0, u(0.5, 1.0))),
        "rough_shift": torch.where(one.dark, one.roughness - 0.05, torch.where(as_is, 0.0, u(-0.1, 0.4))),
        "f0": one.f0, "f0_follow": normal(0.3),  # F0, and its relative change with lightness
        # from the first surface of the pattern to the second
        "rough_step": two_surfaces * (other.roughness - one.roughness), "f0_step": two_surfaces * f0_step,
        "dolp_factor": one.dolp_factor, "dolp_step": two_surfaces * (other.dolp_factor - one.dolp_factor),
        "raised": (u(0, 1) < 0.4).float(),  # 1: the pattern is in relief
        "by_lightness": (u(0, 1) < 0.6).float(),  # 1: the pattern follows the texture's lightness
        "ior": (1.5 + normal(0.06)).clamp(1.35, 1.7), "bump": bump,
    }  # fmt: skip


def _colors(shape: tuple[int, int], device: torch.device) -> Tensor:
    """Draw random reflectances (B, 3, 3), gray to saturated, dark to light.

    Every second one is mixed as on a display, so that vivid colors have one dark channel, as in paints and plastics.
    """
    value = 0.02 + 0.88 * _u((*shape, 1), device) ** 1.3
    hue = _u((*shape, 3), device)
    saturation = _u((*shape, 1), device) ** 1.5
    low, high = hue.amin(dim=-1, keepdim=True), hue.amax(dim=-1, keepdim=True)
    pure = value * (1 - saturation * (hue - low) / (high - low)) ** 2.2
    mixed = value * (1 - saturation * hue)
    return torch.where(_u((*shape, 1), device) < 0.5, pure, mixed).clamp(0.01, 0.95)


def _noise_volume(seed: int) -> Tensor:
    """Volume (1, 7, D, D, D) of four multi-octave noises and the gradient of the last."""
    generator = torch.Generator().manual_seed(seed)
    volume = torch.zeros(1, 4, _SIDE, _SIDE, _SIDE)
    for cells, weight in ((4, 1.0), (8, 0.55), (16, 0.3), (24, 0.15)):
        octave = torch.randn(1, 4, cells, cells, cells, generator=generator)
        volume += weight * F.interpolate(octave, size=(_SIDE,) * 3, mode="trilinear", align_corners=True)
    volume = volume / volume.std(dim=(2, 3, 4), keepdim=True)
    steps = [torch.gradient(volume[0, 3], dim=d)[0] for d in (2, 1, 0)]  # x runs along the last axis
    gradient = torch.stack(steps)[None]
    return torch.cat([volume, gradient / gradient.std()], dim=1)


def _mirror(x: Tensor) -> Tensor:
    """Fold texture coordinates into −1…1, mirrored at odd integers."""
    return (torch.remainder(x + 1, 4) - 2).abs() - 1


def _rotate(matrix: Tensor, vector: Tensor, owner: Tensor) -> Tensor:
    return torch.einsum("mij,mj->mi", matrix[owner], vector)


def _u(shape: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.rand(shape, device=device)


def _log_uniform(shape: tuple[int, ...], low: float, high: float, device: torch.device) -> Tensor:
    return torch.exp(math.log(low) + (math.log(high) - math.log(low)) * _u(shape, device))
