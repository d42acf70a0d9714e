"""Materials of synthetic objects: albedo, F0, roughness, refractive index and relief at a position.

Patterns are smooth at the scale of a pixel, so that few samples per pixel do not alias. A texture set is projected
along the axis nearest to the surface's normal, and mirrored at its sides.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from polcap.formats import scene_files
from polcap.image_values import Floats
from polcap.optics import frames, fresnel

Color = tuple[float, float, float]  # linear Rec.709
_TEXELS = 256  # side of a texture; about one texel per pixel for 0.1 m, so that it does not alias


class Material(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two colors mixed by a pattern, which mixes their roughness in the same proportion.

    With a texture set, the color is its albedo times `first`, and the proportion is its roughness.
    """

    first: Color
    second: Color
    pattern: Literal["plain", "noise", "chequer", "veins"] = "noise"
    size: Annotated[float, Meta(gt=0)] = 0.02  # m, of the pattern's features, or side of the texture
    roughness: tuple[float, float] = (0.4, 0.4)  # perceptual, of the first and of the second color
    specular: Annotated[float, Meta(ge=0)] = 1.0  # k_s: F0 = k_s ((n − 1)/(n + 1))²
    ior: Annotated[float, Meta(gt=1)] = 1.5
    seed: int = 0
    texture: str | UnsetType = UNSET  # folder of a texture set


class Coat(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The material of an object: one, or two in separate regions."""

    materials: tuple[Material, ...]  # one or two
    region_size: float = 0.08  # m
    seed: int = 0


def evaluate(coat: Coat, position: Floats, facing: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Evaluate the material at positions (..., 3) [m] in the object's frame.

    Returns diffuse albedo (..., 3), specular F0 (..., 3), roughness (...,) and refractive index (...,). `facing`
    (..., 3) are the normals without relief.
    """
    parts = [_evaluate_one(material, position, facing) for material in coat.materials]
    joined = _choose(coat, position, [np.concatenate([d, f, r[..., None], n[..., None]], -1) for d, f, r, n in parts])
    return joined[..., :3], joined[..., 3:6], joined[..., 6], joined[..., 7]


def add_relief(coat: Coat, position: Floats, facing: Floats) -> Floats:
    """Normals tilted by the relief of the texture sets; without a texture set `facing` itself."""
    if all(material.texture is UNSET for material in coat.materials):
        return facing
    slope = _choose(coat, position, [_slope(material, position, facing) for material in coat.materials])
    bent = frames.tilted(facing, slope)
    return np.asarray(bent / np.maximum(np.linalg.norm(bent, axis=-1, keepdims=True), 1e-12))


def solid_noise(p: Floats, seed: int) -> Floats:
    """Band-limited noise of mean 0 and variance 1, features about 1 across; (..., 3) -> (...,)."""
    random = np.random.default_rng([seed, 0x501D])
    total = np.zeros(p.shape[:-1])
    for octave in range(3):
        for _ in range(5):
            direction = random.normal(size=3)
            k = direction / np.linalg.norm(direction) * (2.0 * 1.7**octave * random.uniform(0.8, 1.25))
            phase = p[..., 0] * k[0] + p[..., 1] * k[1] + p[..., 2] * k[2] + random.uniform(0, 6.3)
            total += 0.7**octave * np.sin(phase.astype(np.float32))
    return np.asarray(total / np.sqrt(2.5 * sum(0.49**octave for octave in range(3))))  # five waves of variance ½ each


def _choose(coat: Coat, position: Floats, parts: list[Floats]) -> Floats:
    """Select the values (..., C) of the first or the second material by the region of each position."""
    if len(parts) == 1:
        return parts[0]
    second = solid_noise(position / coat.region_size, coat.seed) > 0
    return np.where(second[..., None], parts[1], parts[0])


def _evaluate_one(material: Material, position: Floats, facing: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Diffuse albedo, F0, roughness and refractive index of one material at points (N, 3)."""
    first, second = np.array(material.first), np.array(material.second)
    if material.texture is UNSET:
        share = _pattern(material, position / material.size)
        diffuse = first + (second - first) * share[..., None]
    else:
        picture, _, _ = _project(material, position, facing)
        diffuse, share = first * picture[..., :3], picture[..., 3]
    f0 = material.specular * fresnel.normal_reflectance(material.ior)
    roughness = material.roughness[0] + (material.roughness[1] - material.roughness[0]) * share
    return diffuse, np.full_like(diffuse, f0), roughness, np.full_like(share, material.ior)


def _slope(material: Material, position: Floats, facing: Floats) -> Floats:
    """Slope of a texture set's relief along the object's axes, (..., 3), at positions; 0 without a texture set."""
    out = np.zeros_like(facing)
    if material.texture is not UNSET:
        picture, axis, sign = _project(material, position, facing)
        for k in (0, 1):
            np.put_along_axis(out, (axis + k + 1) % 3, picture[..., 4 + k, None] * sign[..., k, None], axis=-1)
    return out


def _project(material: Material, position: Floats, facing: Floats) -> tuple[Floats, Any, Floats]:
    """Look up a texture set at positions (..., 3), projected along the object's axis nearest to the normal.

    Returns the values (..., 6), the axis of projection (..., 1), and the signs of u and v, −1 where mirrored (..., 2).
    """
    texture = _texture(str(material.texture))
    axis = np.abs(facing).argmax(axis=-1)[..., None]
    across = np.concatenate([np.take_along_axis(position, (axis + k) % 3, axis=-1) for k in (1, 2)], axis=-1)
    along = np.mod(across / material.size, 2)  # 0…2: there and mirrored back
    at = np.where(along < 1, along, 2 - along) * (_TEXELS - 1)
    corner = np.minimum(at.astype(np.intp), _TEXELS - 2)
    column, row = corner[..., 0], corner[..., 1]
    u, v = (at - corner)[..., :1], (at - corner)[..., 1:]
    upper = texture[row, column] * (1 - u) + texture[row, column + 1] * u
    lower = texture[row + 1, column] * (1 - u) + texture[row + 1, column + 1] * u
    return upper * (1 - v) + lower * v, axis, np.where(along < 1, 1.0, -1.0)


@lru_cache(maxsize=4)
def _texture(folder: str) -> Floats:
    """Texture set (_TEXELS, _TEXELS, 6): albedo, roughness, slopes of the relief along columns and rows."""
    return np.ascontiguousarray(np.moveaxis(scene_files.read_textures(Path(folder), _TEXELS), 0, -1))


def _pattern(material: Material, p: Floats) -> Floats:
    """Share 0…1 of the material's second color at positions p, (...,)."""
    if material.pattern == "plain":
        return np.zeros(p.shape[:-1])
    if material.pattern == "chequer":
        edge = np.prod(np.sin(np.pi * p), axis=-1) / 0.15
    else:
        noise = solid_noise(p, material.seed)
        edge = (0.25 - np.abs(noise)) / 0.15 if material.pattern == "veins" else noise / 1.2
    t = np.clip((edge + 1) / 2, 0, 1)  # `edge` −1: first color, 1: second, smooth between
    return np.asarray(t * t * (3 - 2 * t))
