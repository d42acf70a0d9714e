"""Metric height of each texel, integrated from its slopes, and low frequencies from parallax.

Slopes give detail, but add up to large errors over many texels; parallax gives the coarse shape. Their least squares
solution is a Poisson equation with a tie to the coarse height, which cosine transforms solve.

References
----------
Frankot & Chellappa, A method for enforcing integrability in shape from shading algorithms, IEEE TPAMI 1988.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import dctn, idctn

from polcap.images import ArrayValue, Bools, Floats
from polcap.material.coarse_relief import CROSSOVER, CoarseRelief
from polcap.material.texel_fit import ALBEDO, F0, ROUGHNESS, SLOPES, UNKNOWNS, normals
from polcap.material.texel_grid import TexelGrid
from polcap.material.texel_maps import TexelMaps
from polcap.optics.outline import fill_outward
from polcap.stages import stage

_DIRECTIONS, _GROWTH = 12, 1.25  # of the horizon's search; ratio of successive distances
_FARTHEST = 0.1  # of the longer side
_MISPLACED = 0.25  # texels, 1σ of a texel's place in a view


@dataclass(frozen=True, repr=False)
class MaterialMaps(ArrayValue):
    """Maps of a flat sample, in the plane's frame: x right, y up the page, z out of it."""

    normal: Floats  # (H, W, 3) unit
    diffuse: Floats  # (H, W, 3) albedo ρ_d, linear Rec.709
    specular: Floats  # (H, W, 3) F0, gray
    roughness: Floats  # (H, W) perceptual
    height: Floats  # (H, W) m, mean 0
    occlusion: Floats  # (H, W) share of a uniform sky
    normal_sigma: Floats  # (H, W) degrees, 1σ
    diffuse_sigma: Floats  # (H, W) mean of the colors
    roughness_sigma: Floats  # (H, W)
    specular_sigma: Floats  # (H, W)
    seen: Bools  # (H, W) measured; elsewhere filled
    thickness: float  # m, mean height over the board
    albedo_sigma: float | None = None

    @property
    def mask(self) -> Bools:
        """All texels: a plane has no outline."""
        return np.ones(self.seen.shape, bool)

    @property
    def detail(self) -> None:
        """No detail beyond the texels."""
        return None


@stage(version=2)
def build(found: TexelMaps, relief: CoarseRelief, grid: TexelGrid, albedo_sigma: float | None) -> MaterialMaps:
    """Integrate heights, fill texels that were not measured, and compute ambient occlusion."""
    filled = fill_outward(np.concatenate([found.value, found.sigma], axis=-1), found.seen)
    value, sigma = filled[..., :UNKNOWNS], filled[..., UNKNOWNS:]
    height = integrate(value[..., SLOPES], relief.height, grid.texel)
    normal = normals(value)
    middle = float(height.mean())
    return MaterialMaps(
        normal=np.asarray(normal, np.float32),
        diffuse=value[..., ALBEDO],
        specular=np.repeat(value[..., F0, None], 3, axis=-1),
        roughness=value[..., ROUGHNESS],
        height=np.asarray(height - middle, np.float32),
        occlusion=ambient_occlusion(height, normal, grid.texel),
        normal_sigma=np.degrees(np.hypot(sigma[..., 0], sigma[..., 1])) * normal[..., 2] ** 2,
        diffuse_sigma=_albedo_doubt(value[..., ALBEDO], sigma[..., ALBEDO].mean(axis=-1), albedo_sigma or 0.0),
        roughness_sigma=sigma[..., ROUGHNESS],
        specular_sigma=sigma[..., F0],
        seen=found.seen,
        thickness=middle,
        albedo_sigma=albedo_sigma,
    )


def _albedo_doubt(albedo: Floats, sigma: Floats, scale: float) -> Floats:
    """1σ (H, W) of the albedo (H, W, 3): of its texel (H, W), of its scale (relative), and of its place at edges."""
    gray = albedo.mean(axis=-1)
    down, across = np.gradient(gray)
    return np.asarray(np.sqrt(sigma**2 + (scale * gray) ** 2 + _MISPLACED**2 * (down**2 + across**2)), np.float32)


def integrate(slope: Floats, coarse: Floats, texel: float) -> Floats:
    """Height (H, W) [m] with slopes (H, W, 2) to the right and up, near the height `coarse` (H, W) over long ranges."""
    height, width = coarse.shape
    across = (slope[:, :-1, 0] + slope[:, 1:, 0]) * (texel / 2)  # rises between neighbors
    down = -(slope[:-1, :, 1] + slope[1:, :, 1]) * (texel / 2)
    divergence = np.zeros((height, width))
    divergence[:, :-1] -= across
    divergence[:, 1:] += across
    divergence[:-1] -= down
    divergence[1:] += down
    tie = CROSSOVER**-2
    waves = [2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (height, width)]
    laplacian = waves[0][:, None] + waves[1][None]
    right = dctn(divergence + tie * coarse, norm="ortho")
    return np.asarray(idctn(right / (laplacian + tie), norm="ortho"))


def ambient_occlusion(height: Floats, normal: Floats, texel: float) -> Floats:
    """Share (H, W) of a uniform sky, weighted by the cosine, that the relief leaves visible, from its horizons."""
    rows, columns = height.shape
    smooth = np.asarray(height, np.float32)
    farthest = max(2.0, _FARTHEST * max(rows, columns))
    distances = np.unique(np.rint(_GROWTH ** np.arange(np.log(farthest) / np.log(_GROWTH) + 1)).astype(int))
    share = np.zeros((rows, columns), np.float32)
    for angle in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        tangent = -(normal[..., 0] * np.cos(angle) + normal[..., 1] * np.sin(angle)) / normal[..., 2]
        horizon = tangent.astype(np.float32)
        for distance in distances:
            matrix = np.array([[1, 0, distance * np.cos(angle)], [0, 1, -distance * np.sin(angle)]], np.float32)
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            there = cv2.warpAffine(smooth, matrix, (columns, rows), flags=flags, borderMode=cv2.BORDER_REFLECT)
            np.maximum(horizon, (there - smooth) / (distance * texel), out=horizon)
        sine = horizon / np.sqrt(1 + horizon**2) - tangent / np.sqrt(1 + tangent**2)
        share += (1 - np.clip(sine, 0, 1) ** 2) / _DIRECTIONS
    return np.asarray(np.clip(share, 0, 1))
