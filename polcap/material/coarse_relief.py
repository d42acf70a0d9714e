"""Height of the sample over the board, on coarse texels, from parallax and normals.

1. The plane on which the textures of all views agree best gives the sample's thickness.
2. Fits of coarse texels give normals, and the radiance that each view should show.
3. At a wrong height, a view shows the radiance of a neighboring texel; least squares over a window correct the height.
4. Heights from normals and from parallax are joined, weighted by their errors. Steps 2 to 4 are repeated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from scipy import sparse
from scipy.sparse.linalg import spsolve

from polcap.image_values import ArrayValue, Floats
from polcap.material import flash_light, texel_grid, texel_stokes
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_fit import SLOPES, FitSettings, TexelEstimate, TexelPrior, fit, start
from polcap.material.texel_grid import FlashLight, TexelGrid
from polcap.material.texel_stokes import TexelStokes, measurements, resample
from polcap.optics import body
from polcap.stages import stage

_COARSE = 160  # texels along the longer side, about
_ROUNDS = 3
_WINDOW = 2.5  # coarse texels, 1σ, over which parallax is summed
_THICKEST_M, _LOWEST_M = 0.02, -0.002  # range in which the plane is searched
_SHADING = 6.0  # coarse texels, 1σ of the smoothing that separates shading from texture
_SLOPE_ERROR = 0.03  # 1σ of the coarse slopes
# Heights from parallax err by 0.08 texels. Slopes err by 0.001, and their errors add up: heights from slopes are better
# over waves of up to 500 texels = 2π · CROSSOVER
CROSSOVER = 80.0  # texels
_MOST_STEP = 1.5  # coarse texels of height, in a round
_GLOSS, _GLOSS_SIGMA = (0.45, 0.042), (0.2, 0.012)  # roughness and F0 of common surfaces: mean and 1σ of the prior


@dataclass(frozen=True, repr=False)
class CoarseRelief(ArrayValue):
    """Height of the sample."""

    height: Floats  # (H, W) m over the board, on the fine grid
    sigma: Floats  # (H, W) m, of the heights from parallax alone


class ReliefSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `coarse_relief`."""

    parallax_error: Annotated[
        float, Meta(gt=0, le=1, description="error of a view's radiance in the search for parallax [1]")
    ] = 0.03


@stage(version=3)
def solve(views: tuple[PosedStokes, ...], light: FlashLight, grid: TexelGrid, settings: ReliefSettings) -> CoarseRelief:
    """Height on the fine grid, interpolated from coarse texels."""
    step = max(1, round(max(grid.size) / _COARSE))
    coarse = grid.coarser(step)
    height = np.full(coarse.size[::-1], _find_plane(views, grid, step))
    for number in range(_ROUNDS):
        fine = _enlarge(height, grid, step)
        stokes = resample(views, light, grid, fine, step)
        estimate = _fit(stokes, views, light, coarse, height)
        raised = resample(views, light, grid, fine + coarse.texel, step)
        change, weight = _parallax(stokes, raised, estimate, coarse.texel, settings)
        stereo = height + np.clip(change, -_MOST_STEP * coarse.texel, _MOST_STEP * coarse.texel)
        slope = estimate.value[:, SLOPES].reshape(*height.shape, 2)
        reach = None if number == 0 else CROSSOVER / step  # at first, misplaced texels give wrong slopes
        height = _join(stereo, weight, slope, coarse.texel, reach)
    sigma = 1 / np.sqrt(np.maximum(weight, 1e-30))
    return CoarseRelief(_enlarge(height, grid, step), _enlarge(np.minimum(sigma, 1.0), grid, step))  # 1 m: not known


def _enlarge(image: Floats, grid: TexelGrid, step: int) -> Floats:
    """An image of coarse texels, interpolated on the fine grid (H, W), float32."""
    width, height = grid.size
    x = ((np.arange(width) + 0.5) / step - 0.5).astype(np.float32)
    y = ((np.arange(height) + 0.5) / step - 0.5).astype(np.float32)
    across, down = (np.ascontiguousarray(a) for a in np.broadcast_arrays(x[None], y[:, None]))
    return np.asarray(cv2.remap(image.astype(np.float32), across, down, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE))


def _find_plane(views: tuple[PosedStokes, ...], grid: TexelGrid, step: int) -> float:
    """Height [m] of the plane over the board on which the textures of all views agree best."""
    coarse = grid.coarser(step)
    pictures = [_log_picture(view, step) for view in views]

    def disagreement(height: float) -> float:
        point = coarse.points(np.full(coarse.size[::-1], height))
        detail = np.stack([_detail(view, one, point) for view, one in zip(views, pictures, strict=True)])
        return float(np.median((detail - np.median(detail, axis=0)) ** 2, axis=0).mean() + 1e-12)

    heights = np.arange(_LOWEST_M, _THICKEST_M + coarse.texel, coarse.texel)
    cost = np.array([disagreement(height) for height in heights])
    best = int(np.clip(cost.argmin(), 1, len(heights) - 2))
    before, least, after = cost[best - 1 : best + 2]
    bend = before - 2 * least + after
    vertex = np.clip((before - after) / (2 * bend), -1, 1) if bend > 0 else 0.0  # of a parabola, in steps
    return float(heights[best] + coarse.texel * vertex)


def _log_picture(view: PosedStokes, step: int) -> Floats:
    """ln S0 (H, W), gray, of a view, in means of about a coarse texel; NaN where not measured."""
    gray = np.asarray(view.stokes.stokes[0] @ flash_light.gray(view.matrix), np.float32)
    log = np.log(cv2.blur(np.maximum(gray, 1e-3), (step, step)))  # finite in the dark
    return np.where((view.stokes.quality & texel_stokes.UNKNOWN) > 0, np.nan, log)


def _detail(view: PosedStokes, picture: Floats, point: Floats) -> Floats:
    """Texture (H, W) of a `_log_picture` at world points (H, W, 3): ln S0 less its smoothed values; 0: not measured."""
    x, y = (a.astype(np.float32) for a in view.pixels(point))
    log = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    log = np.nan_to_num(log, nan=0.0)
    return np.asarray(log - cv2.GaussianBlur(log, (0, 0), _SHADING))


def _fit(
    stokes: TexelStokes, views: Sequence[PosedStokes], light: FlashLight, grid: TexelGrid, height: Floats
) -> TexelEstimate:
    """Fit all coarse texels at heights (H, W) [m], with a wide prior of their gloss."""
    data = measurements(stokes, views)
    geometry = texel_grid.geometry(grid.points(height).reshape(-1, 3), [view.pose for view in views], light)
    prior = TexelPrior.alike(_GLOSS, _GLOSS_SIGMA, data.radiance.shape[1])
    first = start(data, geometry, prior, body.SMOOTH)
    return fit(data, geometry, prior, first, body.SMOOTH, FitSettings())


def _parallax(
    stokes: TexelStokes, raised: TexelStokes, estimate: TexelEstimate, lift: float, settings: ReliefSettings
) -> tuple[Floats, Floats]:
    """Change (H, W) [m] of the height that makes all views agree, and its inverse variance.

    `raised` are the views resampled at heights greater by `lift` [m]; they give the derivative of the radiance.
    """
    known = np.isfinite(stokes.noise[..., 0]) & np.isfinite(raised.noise[..., 0])
    here, above = (one.radiance.mean(axis=-1) for one in (stokes, raised))
    model = estimate.model.reshape(here.shape)
    level = np.maximum(model, 1e-3)
    derivative = np.where(known, (above - here) / level / lift, 0)
    common = derivative.sum(axis=0) / np.maximum(known.sum(axis=0), 1)  # to all views: the albedo explains it
    derivative = np.where(known, derivative - common, 0)
    error = np.where(known, np.clip((model - here) / level, -0.5, 0.5), 0)  # relative; limits outliers
    right, square = (cv2.GaussianBlur((derivative * part).sum(axis=0), (0, 0), _WINDOW) for part in (error, derivative))
    weight = square * (4 * np.pi * _WINDOW**2) / settings.parallax_error**2  # the window averages 4πσ² texels
    return np.asarray(right / np.maximum(square, 1e-12)), np.asarray(weight)


def _join(stereo: Floats, weight: Floats, slope: Floats, texel: float, reach: float | None) -> Floats:
    """Height (H, W) [m] by least squares, from heights `stereo` of inverse variance `weight`, and slopes (H, W, 2).

    `reach` limits the weight of `stereo`: the slopes decide over less than about `reach` texels; None: no limit.
    """
    index = np.arange(stereo.size).reshape(stereo.shape)
    first = np.concatenate([index[:, :-1].ravel(), index[1:].ravel()])  # rows run down, slopes up
    second = np.concatenate([index[:, 1:].ravel(), index[:-1].ravel()])
    across, up = slope[:, :-1, 0] + slope[:, 1:, 0], slope[1:, :, 1] + slope[:-1, :, 1]
    rise = np.concatenate([across.ravel(), up.ravel()]) * (texel / 2)  # from the first to the second texel
    count = len(first)
    ends = np.repeat(np.arange(count), 2), np.stack([first, second], axis=-1).ravel()
    differences: Any = sparse.csr_matrix((np.tile([-1.0, 1.0], count), ends), (count, index.size))
    slope_weight = 1 / (_SLOPE_ERROR * texel) ** 2
    # windows overlap, so a texel has a share of its weight; a little more makes the system solvable without any
    tie = weight.ravel() / (2 * np.pi * _WINDOW**2) + slope_weight * 1e-8
    if reach is not None:
        tie = np.minimum(tie, slope_weight / reach**2)
    system = slope_weight * (differences.T @ differences) + sparse.diags(tie)
    right = slope_weight * (differences.T @ rise) + tie * stereo.ravel()
    return np.asarray(spsolve(system.tocsc(), right)).reshape(stereo.shape)
