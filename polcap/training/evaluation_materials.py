"""The 30 test materials of the evaluation: 10 texture sets, 20 solid patterns of kinds that training does not use.

Wood, marble, Voronoi cells, stripes, checks, dots, brushed grain. A material follows from its number. Color, relief,
roughness and F0 share one pattern, as in real materials. Unit of length: the longest side of the object.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from polcap.formats import scene_files
from polcap.image_values import Floats, Indices

TEXTURES, PATTERNS = 10, 20  # of the figures in polcap's pages
_SEED = 2021
_STEP = 1e-3  # of the numerical gradient
_MAX_SLOPE = 0.6  # of the relief
_ORDINARY, _STRONG = (0.030, 0.052), (0.06, 0.26)  # protocol 1: F0 of every second material, and of the others
_COMMON, _RARE = (0.034, 0.055), (0.06, 0.18)  # protocol 2: F0 of four of five materials, and of the fifth

ToneAndGroove = Callable[[Floats], tuple[Floats, Floats]]  # (M, 3) -> tone 0…1, depth of grooves 0…1; (M,) each


@dataclass(frozen=True)
class MaterialSample:
    """Diffuse albedo, F0 and roughness of a test material at M positions."""

    diffuse: Floats  # (M, 3)
    specular: Floats  # (M, 3) F0
    roughness: Floats  # (M,)


@dataclass(frozen=True)
class TestMaterial:
    """A test material as functions of position (M, 3) and of the surface's direction (M, 3)."""

    name: str
    ior: float
    at: Callable[[Floats, Floats], MaterialSample]
    slope: Callable[[Floats, Floats], Floats]  # (M, 3) gradient of the relief; outward is up


def test_materials(folder: Path, *, everyday: bool = False) -> list[TestMaterial]:
    """All test materials: the texture sets of `folder` in alphabetical order, then the patterns.

    everyday: F0 as in everyday objects, mostly about 0.045; else about 0.04 for one half and far higher for the other.
    """
    sets = sorted(p for p in folder.iterdir() if (p / "albedo.jpg").exists()) if folder.exists() else []
    names = list(_FAMILIES)
    patterned = [_pattern(names[k % len(names)], TEXTURES + k, everyday) for k in range(PATTERNS)]
    return [_textured(path, k, everyday) for k, path in enumerate(sets)] + patterned


def _levels(number: int, everyday: bool) -> tuple[np.random.Generator, float, float]:
    """Random generator, refractive index and mean F0 of the test material with this number."""
    rng = np.random.default_rng([_SEED, number])
    ior = 1.4 + 0.2 * ((7 * number) % 30) / 29  # evenly spread over 30 numbers, in mixed order; F0 over 15
    if everyday:
        low, high = _COMMON if number % 5 else _RARE
    else:
        low, high = _ORDINARY if number % 2 else _STRONG
    return rng, ior, low * (high / low) ** (((4 * number) % 15) / 14)


def _textured(folder: Path, number: int, everyday: bool) -> TestMaterial:
    """Test material from a texture set, projected along the nearest axis and mirrored at its edges."""
    rng, ior, level = _levels(number, everyday)
    maps = np.ascontiguousarray(scene_files.read_textures(folder).transpose(1, 2, 0))  # albedo, roughness, two slopes
    mean = float((maps[..., :3].mean(axis=-1) ** 0.45).mean())
    scale, follow, relief = rng.uniform(0.8, 2.0), rng.uniform(-0.5, 0.5), rng.uniform(0.2, 0.5)

    def sampled(place: Floats, facing: Floats) -> tuple[Floats, Indices, Indices]:
        axis = np.abs(facing).argmax(axis=1)
        rows, across, up = np.arange(len(axis)), (axis + 1) % 3, (axis + 2) % 3
        folded = (1 - np.abs(np.mod(place[rows, a] * scale, 2) - 1) for a in (across, up))  # 0…1, mirrored at integers
        u, v = (part * (len(maps) - 1) for part in folded)
        return _sampled(maps, u, v), across, up

    def at(place: Floats, facing: Floats) -> MaterialSample:
        seen, _, _ = sampled(place, facing)
        albedo = np.clip(seen[:, :3], 0.005, 0.95)
        lightness = albedo.mean(axis=1) ** 0.45 - mean
        specular = np.repeat(np.clip(level * (1 + follow * lightness), 0.02, 0.35)[:, None], 3, axis=1)
        return MaterialSample(albedo, specular, np.clip(seen[:, 3], 0.12, 1))

    def slope(place: Floats, facing: Floats) -> Floats:
        seen, across, up = sampled(place, facing)
        out, rows = np.zeros_like(place), np.arange(len(place))
        out[rows, across], out[rows, up] = relief * seen[:, 4], relief * seen[:, 5]
        return out

    return TestMaterial(folder.name, ior, at, slope)


def _sampled(image: Floats, u: Floats, v: Floats) -> Floats:
    """Sample an image (H, W, 6) bilinearly at coordinates u, v (M,); returns (M, 6)."""
    side = 2**14  # remap is limited to pictures under 2^15 px a side
    wide = (len(u) // side + 1) * side
    x, y = (np.pad(a, (0, wide - len(u))).astype(np.float32).reshape(-1, side) for a in (u, v))
    # and to pictures of at most four channels, so the six are sampled in two halves
    halves = (np.ascontiguousarray(image[..., part]) for part in (slice(0, 3), slice(3, 6)))
    parts = [cv2.remap(half, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for half in halves]
    return np.concatenate([p.reshape(wide, 3)[: len(u)] for p in parts], axis=1)


def _pattern(family: str, number: int, everyday: bool) -> TestMaterial:
    """Test material with two colors, two glosses and a relief that follow one pattern (`test_materials`)."""
    rng, ior, level = _levels(number, everyday)
    field = _FAMILIES[family](rng)
    first, second = _color(rng), _color(rng)
    if rng.random() < 0.5:  # two shades of one color
        second = first * rng.uniform(0.2, 0.6)
    rough, change = rng.uniform(0.2, 0.7), rng.uniform(0.08, 0.3) * rng.choice([-1, 1])
    # how F0 and height follow the tone; rms slope of the relief
    follow, raised, steep = rng.uniform(-0.6, 0.6), rng.uniform(-0.4, 0.4), rng.uniform(0.03, 0.2)
    # decided as in protocol 1: with the same draws before `sample`, both protocols have the same relief
    strong = _levels(number, everyday=False)[2] >= 0.1
    tint = 1 + rng.uniform(-0.15, 0.15, 3) if strong else np.array([1.0, 1.0, 1.0])

    def height(place: Floats) -> Floats:
        tone, groove = field(place)
        return raised * tone - groove

    sample = rng.uniform(-0.5, 0.5, (2000, 3))
    rms_slope = np.sqrt(np.mean(_gradient(height, sample) ** 2) * 3) + 1e-9

    def at(place: Floats, facing: Floats) -> MaterialSample:
        tone, groove = field(place)
        mix, deep = tone[:, None], groove[:, None]
        albedo = (first * (1 - mix) + second * mix) * (1 - 0.5 * deep)
        f0 = np.clip(level * (1 + follow * (tone - 0.5)) * (1 - 0.4 * groove), 0.02, 0.35)
        roughness = np.clip(rough + change * (tone - 0.5) * 2 + 0.15 * groove, 0.12, 0.95)
        return MaterialSample(np.clip(albedo, 0.005, 0.95), f0[:, None] * tint, roughness)

    def slope(place: Floats, facing: Floats) -> Floats:
        out = _gradient(height, place) * (steep / rms_slope)
        return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True) / _MAX_SLOPE, 1))

    return TestMaterial(f"{family} {number}", ior, at, slope)


def _gradient(field: Callable[[Floats], Floats], place: Floats) -> Floats:
    here = field(place)
    return np.stack([(field(place + step) - here) / _STEP for step in _STEP * np.eye(3)], axis=1)


def _color(rng: np.random.Generator) -> Floats:
    """Random linear reflectance (3,), dark to light, gray to vivid."""
    hue, saturation, value = rng.uniform(0, 360), rng.uniform(0, 1) ** 1.5, rng.uniform(0.25, 0.95)
    display = cv2.cvtColor(np.array([[[hue, saturation, value]]], np.float32), cv2.COLOR_HSV2RGB)[0, 0]
    return np.asarray(display.astype(np.float64) ** 2.2)


def _waves(rng: np.random.Generator, low: float, high: float, count: int = 10) -> Callable[[Floats], Floats]:
    """A smooth random field of standard deviation about 1. A sum of sines of `low` to `high` cycles over the object."""
    cycles = np.exp(np.linspace(np.log(low), np.log(high), count))
    wave_vectors = rng.normal(size=(3, count))
    wave_vectors *= 2 * np.pi * cycles / np.linalg.norm(wave_vectors, axis=0)
    phase, weight = rng.uniform(0, 2 * np.pi, count), cycles**-0.7
    weight *= np.sqrt(2 / (weight**2).sum())
    return lambda p: np.sin(p @ wave_vectors + phase) @ weight


def _smooth_step(x: Floats, low: float, high: float) -> Floats:
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _wood(rng: np.random.Generator) -> ToneAndGroove:
    """Growth rings with fibers."""
    rings, bend = rng.uniform(8, 20), _waves(rng, 0.7, 4)
    grain, off = _waves(rng, 12, 40), rng.uniform(-0.5, 0.5, 2)

    def field(p: Floats) -> tuple[Floats, Floats]:
        radius = np.hypot(p[:, 0] + off[0], p[:, 1] + off[1]) * rings + 0.35 * bend(p)
        part = np.mod(radius, 1)
        late = part**2 * (1 - _smooth_step(part, 0.9, 1.0))
        fibre = 0.5 + 0.5 * np.tanh(grain(p * [1, 1, 0.06]))
        return np.clip(0.75 * late / 0.8 + 0.25 * fibre, 0, 1), 0.3 * late + 0.2 * fibre

    return field


def _marble(rng: np.random.Generator) -> ToneAndGroove:
    """Marble: planes of narrow veins across z, bent by a smooth field, on a weakly clouded ground; numbers by eye."""
    cycles, swirl, width = rng.uniform(2, 5), _waves(rng, 1, 9, 14), rng.uniform(0.1, 0.35)  # width: sine of a phase
    cloud = _waves(rng, 0.8, 4)

    def field(p: Floats) -> tuple[Floats, Floats]:
        vein = np.exp(-((np.sin(np.pi * (cycles * p[:, 2] + 0.9 * swirl(p))) / width) ** 2))
        return np.clip(vein + 0.15 * (1 + cloud(p)), 0, 1), 0.3 * vein

    return field


def _scattered(rng: np.random.Generator, side: int) -> Floats:
    """Random points, side³ of them, over the object and around it: one in each cell of a grid."""
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return (cells + rng.uniform(0.05, 0.95, cells.shape)) / side * 2 - 1


def _cells(rng: np.random.Generator) -> ToneAndGroove:
    """Voronoi cells of one shade each, with joints."""
    side = int(rng.integers(10, 22))
    points, joint = _scattered(rng, side), 0.12 * 2 / side
    tree, shade = cKDTree(points), rng.uniform(0, 1, len(points))

    def field(p: Floats) -> tuple[Floats, Floats]:
        distance, which = (np.asarray(found) for found in tree.query(p, k=2))
        return shade[which[:, 0]], 1 - _smooth_step(distance[:, 1] - distance[:, 0], 0, 3 * joint)

    return field


def _stripes(rng: np.random.Generator) -> ToneAndGroove:
    """Wavy stripes of two shades."""
    count, share, bend = rng.uniform(5, 16), rng.uniform(0.25, 0.75), _waves(rng, 0.7, 2)

    def field(p: Floats) -> tuple[Floats, Floats]:
        part = np.abs(np.mod(p[:, 0] * count + 0.15 * bend(p), 1) * 2 - 1)  # 0…1…0 over a stripe
        return _smooth_step(part, share - 0.06, share + 0.06), np.exp(-(((part - share) / 0.08) ** 2))

    return field


def _checks(rng: np.random.Generator) -> ToneAndGroove:
    """Cubes of two shades, with joints."""
    count, joint = rng.uniform(4, 10), rng.uniform(0.02, 0.08)

    def field(p: Floats) -> tuple[Floats, Floats]:
        scaled = p * count
        edge = np.abs(scaled - np.round(scaled)).min(axis=1)  # distance to the nearest face, in cubes
        return np.floor(scaled).sum(axis=1) % 2, 1 - _smooth_step(edge, 0, 2 * joint)

    return field


def _dots(rng: np.random.Generator) -> ToneAndGroove:
    """Balls of another shade at scattered points."""
    side = int(rng.integers(14, 30))
    tree, radius = cKDTree(_scattered(rng, side)), rng.uniform(0.3, 0.5)  # in cells of the grid of points

    def field(p: Floats) -> tuple[Floats, Floats]:
        distance = np.asarray(tree.query(p)[0]) * side / 2
        return 1 - _smooth_step(distance, radius - 0.06, radius), np.clip(1 - distance / radius, 0, 1) ** 2

    return field


def _brushed(rng: np.random.Generator) -> ToneAndGroove:
    """Fine lines along one axis."""
    lines, cloud = _waves(rng, 8, 40, 24), _waves(rng, 1, 4)

    def field(p: Floats) -> tuple[Floats, Floats]:
        grain = lines(p * [1, 1, 0.04])
        return np.clip(0.5 + 0.25 * grain + 0.15 * cloud(p), 0, 1), 0.5 + 0.3 * np.tanh(grain)

    return field


_FAMILIES: dict[str, Callable[[np.random.Generator], ToneAndGroove]] = {
    "wood": _wood, "marble": _marble, "cells": _cells, "stripes": _stripes, "checks": _checks, "dots": _dots,
    "brushed": _brushed,
}  # fmt: skip
