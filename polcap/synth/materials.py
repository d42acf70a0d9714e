"""Solid textures: position in the object's own frame -> albedo, F0, roughness and refractive index.

Every pattern is smooth at the scale of a pixel, so that a few samples per pixel do not alias.
"""

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.images import Floats
from polcap.optics import fresnel

Color = tuple[float, float, float]  # linear Rec.709


class Material(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two colours mixed by a pattern; the second one's share moves the roughness as well."""

    first: Color
    second: Color
    pattern: Literal["plain", "noise", "chequer", "veins"] = "noise"
    size: Annotated[float, Meta(gt=0)] = 0.02  # m, of the pattern's features
    roughness: tuple[float, float] = (0.4, 0.4)  # perceptual, of the first and of the second
    specular: Annotated[float, Meta(ge=0)] = 1.0  # k_s: F0 = k_s ((n − 1)/(n + 1))²
    ior: Annotated[float, Meta(gt=1)] = 1.5
    seed: int = 0


class Coat(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an object is made of: one material, or two in regions whose border winds through the solid."""

    materials: tuple[Material, ...]  # one or two
    region_size: float = 0.08  # m
    seed: int = 0


def evaluate(coat: Coat, position: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Diffuse albedo (..., 3), specular F0 (..., 3), roughness (...,) and index (...,) at positions (..., 3) [m]."""
    parts = [_one(material, position) for material in coat.materials]
    if len(parts) == 1:
        return parts[0]
    second = solid_noise(position / coat.region_size, coat.seed) > 0
    a, b = parts
    return (
        np.where(second[..., None], b[0], a[0]),
        np.where(second[..., None], b[1], a[1]),
        np.where(second, b[2], a[2]),
        np.where(second, b[3], a[3]),
    )


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
    return np.asarray(total / np.sqrt(2.5 * sum(0.49**octave for octave in range(3))))


def _one(material: Material, position: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    share = _pattern(material, position / material.size)
    first, second = np.array(material.first), np.array(material.second)
    diffuse = first + (second - first) * share[..., None]
    f0 = material.specular * fresnel.normal_reflectance(material.ior)
    roughness = material.roughness[0] + (material.roughness[1] - material.roughness[0]) * share
    return diffuse, np.full_like(diffuse, f0), roughness, np.full_like(share, material.ior)


def _pattern(material: Material, p: Floats) -> Floats:
    """Share 0…1 of the second colour, (...,)."""
    if material.pattern == "plain":
        return np.zeros(p.shape[:-1])
    if material.pattern == "chequer":
        return _step(np.prod(np.sin(np.pi * p), axis=-1) / 0.15)
    noise = solid_noise(p, material.seed)
    if material.pattern == "veins":
        return _step((0.25 - np.abs(noise)) / 0.15)
    return _step(noise / 1.2)


def _step(x: Floats) -> Floats:
    """0 below −1, 1 above 1, smooth between."""
    t = np.clip((x + 1) / 2, 0, 1)
    return t * t * (3 - 2 * t)
