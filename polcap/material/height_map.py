"""Metric height of each texel, integrated from its slopes, and low frequencies from parallax.

Slopes give detail, but their errors add up over many texels; parallax gives the coarse shape. Least squares of both are
a Poisson equation with a term that holds the height near the coarse one. Each slope is weighted by its error, so the
equation is solved by conjugate gradients; cosine transforms, which solve it for equal errors, are the preconditioner.

References
----------
Frankot & Chellappa, A method for enforcing integrability in shape from shading algorithms, IEEE TPAMI 1988.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import dctn, idctn
from scipy.sparse.linalg import LinearOperator, cg

from polcap.image_values import ArrayValue, Bools, Floats
from polcap.material.coarse_relief import CROSSOVER, CoarseRelief
from polcap.material.texel_fit import ALBEDO, F0, ROUGHNESS, SLOPES, UNKNOWNS, normals
from polcap.material.texel_grid import TexelGrid
from polcap.material.texel_maps import TexelMaps
from polcap.optics.outline import fill_outward
from polcap.stages import stage

_DIRECTIONS, _GROWTH = 12, 1.25  # of the horizon's search; ratio of successive distances
_FARTHEST = 0.1  # of the longer side
_MISPLACED = 0.25  # texels, 1σ of a texel's place in a view
_PRINT = 0.1  # texels, largest displacement e of a print; slopes that follow the albedo with a larger e are relief
_PRINT_LEFT = 0.02  # texels, 1σ of the remaining displacement: that of a usual one, because it differs by view
_SIDE, _WINDOW = 160, 1 / 9  # texels along the longer side of reduced maps; 1σ of a window over that side
_MOST_WEIGHT = 4.0  # of a slope, over that of the median doubt
_TOLERANCE, _MOST_STEPS = 1e-3, 60  # of the conjugate gradients; about 15 steps are needed


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
    albedo_sigma: float | None = None  # relative 1σ of the scale of all albedos; None: unknown

    @property
    def mask(self) -> Bools:
        """All texels: a plane has no outline."""
        return np.ones(self.seen.shape, bool)

    @property
    def detail(self) -> None:
        """No detail beyond the texels."""
        return None


@stage(version=3)
def build(found: TexelMaps, relief: CoarseRelief, grid: TexelGrid, albedo_sigma: float | None) -> MaterialMaps:
    """Integrate heights, fill texels that were not measured, and compute ambient occlusion."""
    filled = fill_outward(np.concatenate([found.value, found.sigma], axis=-1), found.seen)
    value, sigma = filled[..., :UNKNOWNS], filled[..., UNKNOWNS:]
    value[..., SLOPES], print_doubt = without_print(value[..., SLOPES], value[..., ALBEDO].mean(axis=-1))
    doubt = np.linalg.norm([*np.moveaxis(sigma[..., SLOPES], -1, 0), print_doubt], axis=0)
    height = integrate(value[..., SLOPES], doubt, relief.height, grid.texel)
    normal = normals(value)
    middle = float(height.mean())
    return MaterialMaps(
        normal=np.asarray(normal, np.float32),
        diffuse=value[..., ALBEDO],
        specular=np.repeat(value[..., F0, None], 3, axis=-1),
        roughness=value[..., ROUGHNESS],
        height=np.asarray(height - middle, np.float32),
        occlusion=ambient_occlusion(height, normal, grid.texel),
        normal_sigma=np.degrees(np.hypot(sigma[..., 0], sigma[..., 1])) * normal[..., 2] ** 2,  # dθ = cos² θ d tan θ
        diffuse_sigma=_albedo_doubt(value[..., ALBEDO], sigma[..., ALBEDO].mean(axis=-1), albedo_sigma or 0.0),
        roughness_sigma=sigma[..., ROUGHNESS],
        specular_sigma=sigma[..., F0],
        seen=found.seen,
        thickness=middle,
        albedo_sigma=albedo_sigma,
    )


def _albedo_doubt(albedo: Floats, sigma: Floats, scale: float) -> Floats:
    """1σ (H, W) of the albedo (H, W, 3): `sigma` of its fit, relative `scale` of all albedos, and misplaced edges."""
    gray = albedo.mean(axis=-1)
    down, across = np.gradient(gray)
    return np.asarray(np.sqrt(sigma**2 + (scale * gray) ** 2 + _MISPLACED**2 * (down**2 + across**2)), np.float32)


def without_print(slope: Floats, albedo: Floats) -> tuple[Floats, Floats]:
    """Slopes (H, W, 2) without the part that a misplaced print causes, and 1σ (H, W) of the part that is left.

    `albedo` (H, W) is ρ. A view at the tilt θ may show the print e tan θ texels off. Under a light at the lens this
    looks like a slope of e d ln ρ/dx. So e is fitted to slopes and gradients of ln ρ in a window; it is about 0.02
    texels. A relief that follows the albedo, as a groove does, has a larger e and keeps its slopes.
    """
    height, width = albedo.shape
    step = max(1, round(max(albedo.shape) / _SIDE))
    small = max(1, width // step), max(1, height // step)

    def window(value: Floats) -> Floats:
        mean = cv2.resize(np.asarray(value, np.float32), small, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(mean, (0, 0), _WINDOW * max(small))
        return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR))

    down, across = np.gradient(np.log(np.maximum(albedo, 1e-3)))
    out = np.empty_like(slope)
    for k, gradient in enumerate((across, -down)):
        own = slope[..., k]
        share = window(own * gradient) / (window(gradient**2) + window(own**2) / _PRINT**2 + 1e-12)
        out[..., k] = own - share * gradient
    return out, _PRINT_LEFT * np.hypot(across, down)


def integrate(slope: Floats, sigma: Floats, coarse: Floats, texel: float) -> Floats:
    """Height (H, W) [m] from slopes (H, W, 2) to the right and up, their 1σ (H, W), and the height `coarse` (H, W).

    Over more than about CROSSOVER texels `coarse` decides. The unknown of the equation is the height above `coarse`.
    """
    height, width = coarse.shape
    weight = np.minimum((np.median(sigma) / np.maximum(sigma, 1e-9)) ** 2, _MOST_WEIGHT)
    weights = np.minimum(weight[:, 1:], weight[:, :-1]), np.minimum(weight[1:], weight[:-1])
    rises = (  # between neighbors, less those of the coarse height
        (slope[:, :-1, 0] + slope[:, 1:, 0]) * (texel / 2) - np.diff(coarse, axis=1),
        -(slope[:-1, :, 1] + slope[1:, :, 1]) * (texel / 2) - np.diff(coarse, axis=0),
    )
    tie = CROSSOVER**-2
    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (height, width))
    laplacian = rows[:, None] + columns  # its eigenvalues, for cosine waves

    def divergence(across: Floats, down: Floats) -> Floats:
        total = np.zeros((height, width))
        total[:, :-1] -= across
        total[:, 1:] += across
        total[:-1] -= down
        total[1:] += down
        return total

    def equation(flat: Floats) -> Floats:
        rise = flat.reshape(height, width)
        steps = weights[0] * np.diff(rise, axis=1), weights[1] * np.diff(rise, axis=0)
        return np.asarray((divergence(*steps) + tie * rise).ravel())

    def equal_doubts(flat: Floats) -> Floats:
        waves = dctn(flat.reshape(height, width), norm="ortho") / (laplacian + tie)
        return np.asarray(idctn(waves, norm="ortho")).ravel()

    shape = (height * width,) * 2
    matrix, inverse = (LinearOperator(shape, matvec=one) for one in (equation, equal_doubts))
    right = divergence(weights[0] * rises[0], weights[1] * rises[1]).ravel()
    found, _ = cg(matrix, right, rtol=_TOLERANCE, maxiter=_MOST_STEPS, M=inverse)
    return np.asarray(coarse + found.reshape(height, width))


def ambient_occlusion(height: Floats, normal: Floats, texel: float) -> Floats:
    """Share (H, W) of a uniform sky, weighted by the cosine, that the relief leaves visible, from its horizons."""
    rows, columns = height.shape
    relief = np.asarray(height, np.float32)
    farthest = max(2.0, _FARTHEST * max(rows, columns))
    distances = np.unique(np.rint(_GROWTH ** np.arange(np.log(farthest) / np.log(_GROWTH) + 1)).astype(int))
    share = np.zeros((rows, columns), np.float32)
    for angle in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        tangent = -(normal[..., 0] * np.cos(angle) + normal[..., 1] * np.sin(angle)) / normal[..., 2]
        horizon = tangent.astype(np.float32)  # slope of the line of sight, at first that of the surface
        for distance in distances:
            matrix = np.array([[1, 0, distance * np.cos(angle)], [0, 1, -distance * np.sin(angle)]], np.float32)
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            there = cv2.warpAffine(relief, matrix, (columns, rows), flags=flags, borderMode=cv2.BORDER_REFLECT)
            np.maximum(horizon, (there - relief) / (distance * texel), out=horizon)
        sine = horizon / np.sqrt(1 + horizon**2) - tangent / np.sqrt(1 + tangent**2)
        share += (1 - np.clip(sine, 0, 1) ** 2) / _DIRECTIONS
    return np.asarray(np.clip(share, 0, 1))
