"""Shapes as distance fields for sphere tracing; each in its own frame, in metres.

`distance(p)`, (..., 3) → (...,), is 0 on the surface; outside it is positive and at most the true distance. For this,
a height over the surface is divided by √(1 + its steepest slope²). A sphere of `radius` about the origin contains the
shape.

References
----------
Hart, Sphere tracing, The Visual Computer 1996.
"""

from functools import lru_cache
from math import hypot
from pathlib import Path

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline

from polcap.formats import scene_files
from polcap.image_values import Floats

_GRID = 1024  # points along a side of a slab's relief
Wave = tuple[float, float, float, float, float]  # amplitude, wave vector x y z [rad/unit], phase [rad]


class Cluster(msgspec.Struct, frozen=True, tag="cluster", forbid_unknown_fields=True):
    """Shape of several overlapping balls, as a distance field."""

    balls: tuple[tuple[float, float, float, float], ...]  # center x y z, radius [m]

    @property
    def radius(self) -> float:
        return max(hypot(x, y, z) + r for x, y, z, r in self.balls)

    def distance(self, p: Floats) -> Floats:
        return np.asarray(np.min([_length(p - (x, y, z)) - r for x, y, z, r in self.balls], axis=0))


class Bumps(msgspec.Struct, frozen=True, tag="bumps", forbid_unknown_fields=True):
    """Shape of an ellipsoid with smooth waves on its surface, as a distance field."""

    size: tuple[float, float, float]  # semi-axes [m]
    waves: tuple[Wave, ...]  # amplitude relative to the semi-axis, over the unit sphere

    @property
    def radius(self) -> float:
        return max(self.size) * (1 + sum(abs(wave[0]) for wave in self.waves))

    def distance(self, p: Floats) -> Floats:
        q = p / np.array(self.size)
        r = np.maximum(_length(q), 1e-9)
        slope = sum(abs(a) * hypot(x, y, z) for a, x, y, z, _ in self.waves)
        least = 1 - sum(abs(wave[0]) for wave in self.waves)  # smallest radius: there the waves are steepest
        return (r - 1 - _waves(self.waves, q / r[..., None])) * (min(self.size) / hypot(1, slope / least))


class Vase(msgspec.Struct, frozen=True, tag="vase", forbid_unknown_fields=True):
    """Shape of a solid of revolution about y, with vertical lobes and small waves on its wall, as a distance field."""

    height: float  # m
    profile: tuple[tuple[float, float], ...]  # height 0…1 from foot to lip, radius [m]; joined smoothly
    lobes: int = 0
    depth: float = 0.0  # of the lobes, relative to the radius
    waves: tuple[Wave, ...] = ()  # on the wall [m; rad/m]

    @property
    def radius(self) -> float:
        curve, _ = _wall(self.profile)
        widest = float(curve(np.linspace(0, 1, 257)).max()) * (1 + self.depth)
        return hypot(self.height / 2, widest) + sum(abs(wave[0]) for wave in self.waves)

    def distance(self, p: Floats) -> Floats:
        curve, steepest = _wall(self.profile)
        across = np.maximum(np.hypot(p[..., 0], p[..., 2]), 1e-9)
        wall = curve(np.clip(p[..., 1] / self.height + 0.5, 0, 1))
        lobes = 1.0 + self.depth * np.cos(self.lobes * np.arctan2(p[..., 0], p[..., 2]))
        of_waves = sum(abs(a) * hypot(x, y, z) for a, x, y, z, _ in self.waves)  # slopes, at most
        of_lobes = self.depth * self.lobes / (1 - self.depth)
        slope = hypot(steepest / self.height * (1 + self.depth), of_lobes) + of_waves
        side = (across - wall * lobes - _waves(self.waves, p)) / hypot(1, slope)
        end, width = np.abs(p[..., 1]) - self.height / 2, 0.06 * self.height
        near = np.maximum(width - np.abs(side - end), 0.0) / width
        return np.asarray(np.maximum(side, end) + near * near * (width / 4))  # the rim is rounded over this width


class Model(msgspec.Struct, frozen=True, tag="model", forbid_unknown_fields=True):
    """Shape from a mesh file, centered at the origin. It has no distance field; `optics/mesh_tracer.py` traces it."""

    file: str
    radius: float  # m, of the smallest sphere about the origin that contains it


class Slab(msgspec.Struct, frozen=True, tag="slab", forbid_unknown_fields=True):
    """Shape of a flat square sample with relief on its upper side, y up, as a distance field.

    It lies on the plane y = 0; its upper side is at y = thickness + height, with a height of mean 0.
    """

    side: float  # m
    thickness: float  # m, mean
    relief: float  # m, from the lowest to the highest point
    feature: float = 0.006  # m, size of the features of random relief
    seed: int = 0
    height_map: str = ""  # picture file in place of random relief, white is high

    @property
    def radius(self) -> float:
        return hypot(self.side / np.sqrt(2), self.thickness + self.relief)

    def distance(self, p: Floats) -> Floats:
        _, steepest = _heights(self)
        over = (p[..., 1] - self.thickness - self.height(p[..., 0], p[..., 2])) / hypot(1, steepest)
        beside = np.maximum(np.abs(p[..., 0]), np.abs(p[..., 2])) - self.side / 2
        return np.asarray(np.maximum(np.maximum(over, beside), -p[..., 1]))

    def height(self, x: Floats, z: Floats) -> Floats:
        """Height (...,) [m] of the relief at x and z (...,), bilinear between the points of a fine grid."""
        grid, _ = _heights(self)
        last = len(grid) - 1
        column, row = (np.clip((a / self.side + 0.5) * last, 0, last - 1e-6) for a in (x, z))
        i, j = row.astype(np.intp), column.astype(np.intp)
        down, across = row - i, column - j
        flat, at = grid.ravel(), i * len(grid) + j
        upper = flat[at] * (1 - across) + flat[at + 1] * across
        lower = flat[at + len(grid)] * (1 - across) + flat[at + len(grid) + 1] * across
        return np.asarray(upper * (1 - down) + lower * down)


Shape = Cluster | Bumps | Vase | Slab


@lru_cache(maxsize=4)
def _heights(slab: Slab) -> tuple[Floats, float]:
    """Heights (N, N) [m] of a slab's relief, rows along z, and its steepest slope."""
    if slab.height_map:
        grid = scene_files.read_height(Path(slab.height_map), _GRID).astype(float)
    else:
        white = np.random.default_rng([slab.seed, 0x51AB]).normal(size=(_GRID, _GRID))
        spatial = np.fft.fftfreq(_GRID, slab.side / (_GRID - 1))
        band = np.hypot(spatial[:, None], spatial[None]) * slab.feature
        grid = np.fft.ifft2(np.fft.fft2(white) * band * np.exp(-2 * band**2)).real  # strongest at waves of two features
    grid = (grid - grid.mean()) * (slab.relief / max(float(np.ptp(grid)), 1e-12))
    slope = np.gradient(grid, slab.side / (_GRID - 1))
    return grid, float(np.hypot(*slope).max())


@lru_cache
def _wall(profile: tuple[tuple[float, float], ...]) -> tuple[CubicSpline, float]:
    """Radius of a vase's wall as a spline over height 0…1, and the wall's steepest slope [m per height]."""
    at, radius = np.array(profile).T
    curve = CubicSpline(at, radius, bc_type="natural")
    return curve, float(np.abs(curve(np.linspace(0, 1, 257), 1)).max())


def _length(p: Floats) -> Floats:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", p, p)))


def _waves(waves: tuple[Wave, ...], p: Floats) -> Floats:
    """Sum of plane sine waves at points p (..., 3)."""
    total = np.zeros(p.shape[:-1])
    for amplitude, x, y, z, phase in waves:
        angle = p[..., 0] * x + p[..., 1] * y + p[..., 2] * z + phase
        total += amplitude * np.sin(angle.astype(np.float32))  # three times as fast; error 1e-7 of the amplitude
    return total
