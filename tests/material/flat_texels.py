"""Texels of known material, seen by nine cameras with a flash, as the values that `material` reads."""

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.fusion.values import Pose
from polcap.image_values import Floats
from polcap.material import texel_fit, texel_grid
from polcap.material.texel_fit import Measurements
from polcap.material.texel_grid import FlashLight, TexelViews
from polcap.optics import body

GRAY = np.array([0.3, 0.5, 0.2])
RADIANCE_ERROR, POLARIZATION_ERROR = 0.01, 0.003


def poses() -> list[Pose]:
    """One camera above the board, four tilted by 20°, four by 40°, at 0.6 m."""
    tilts = [(0, 0), *((20, 90 * k) for k in range(4)), *((40, 45 + 90 * k) for k in range(4))]
    turns = [Rotation.from_euler("xy", [90 - tilt, 0], degrees=True) * Rotation.from_euler("y", turn, degrees=True)
             for tilt, turn in tilts]  # fmt: skip
    return [Pose(turn.as_matrix(), np.array([0, 0, -0.6])) for turn in turns]


def views(count: int, seed: int = 0) -> TexelViews:
    """Geometry of random points on 9 cm."""
    x, z = np.random.default_rng([seed, 1]).uniform(-0.045, 0.045, (2, count))
    light = FlashLight(np.array([0.0, 0.05, 0.0]), np.full(9, 0.36), np.empty(0), 0.0, 0.8, 0.0)
    return texel_grid.geometry(np.stack([x, 0 * x, z], axis=-1), poses(), light)


def measured(truth: Floats, seen: TexelViews, law: body.Law = body.SMOOTH, seed: int = 0) -> Measurements:
    """Photographs of texels with these values (N, 7), with errors of radiance and polarization."""
    random = np.random.default_rng([seed, 2])
    response = texel_fit.responses(truth[:, :2], truth[:, 2], seen, law)
    f0, level = truth[:, 3], truth[:, 4:] @ GRAY
    radiance = response[0, ..., :1] * truth[:, 4:] + (response[0, ..., 1] * f0)[..., None]
    polarized = np.moveaxis(response[1:, ..., 0] * level + response[1:, ..., 1] * f0, 0, -1)
    s0 = radiance @ GRAY
    radiance *= 1 + RADIANCE_ERROR * random.normal(size=s0.shape)[..., None]
    polarized = polarized + POLARIZATION_ERROR * s0[..., None] * random.normal(size=polarized.shape)
    noise = np.full((*s0.shape, 2), 1e-5)
    return Measurements(radiance.astype(np.float32), polarized.astype(np.float32), noise.astype(np.float32), GRAY)


def first_views(count: int, data: Measurements, seen: TexelViews) -> tuple[Measurements, TexelViews]:
    """Data and geometry of the first views."""
    measured = Measurements(data.radiance[:count], data.polarized[:count], data.noise[:count], data.gray)
    return measured, TexelViews(seen.normal_to_ray[:count], seen.to_light[:count], seen.irradiance[:count])


def materials(count: int, seed: int = 0) -> Floats:
    """Random values (N, 7) of texels: slopes, roughness, F0, albedo."""
    random = np.random.default_rng([seed, 3])
    low, high = [0.25, 0.03, 0.1, 0.1, 0.1], [0.6, 0.055, 0.8, 0.8, 0.8]
    return np.concatenate([random.normal(0, 0.06, (count, 2)), random.uniform(low, high, (count, 5))], axis=-1).astype(
        np.float32
    )
