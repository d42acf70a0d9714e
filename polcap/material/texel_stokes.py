"""Resampling of the views on the texels of the sample's plane, at given heights."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from polcap.image_values import ArrayValue, Floats, Quality
from polcap.material import flash_light
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_fit import Measurements
from polcap.material.texel_grid import FlashLight, TexelGrid
from polcap.optics.resize import block_means
from polcap.optics.warp import Spline, Taps

_ROWS = 256  # of the grid at a time
_BORDER = 12  # px around the pixels of a strip of the grid, for the splines
_MOST_UNKNOWN = 0.01  # weight of unknown pixels in a texel, by linear interpolation
UNKNOWN = np.uint8(Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST)
_SPLINE_NOISE = 0.7  # standard deviation of a spline between pixels, over that of a pixel


@dataclass(frozen=True, repr=False)
class TexelStokes(ArrayValue):
    """Radiance, polarization and noise that K views measured at each texel."""

    radiance: Floats  # (K, H, W, 3) S0, linear Rec.709
    polarized: Floats  # (K, H, W, 2) S1 and S2 of the gray sum of the channels, in the frame of the ray
    noise: Floats  # (K, H, W, 2) 1σ of the gray S0, and of S1 and S2 each; infinite: not measured

    def rows(self, index: slice) -> "TexelStokes":
        """Some rows of the texels."""
        return TexelStokes(self.radiance[:, index], self.polarized[:, index], self.noise[:, index])


def measurements(stokes: TexelStokes, views: Sequence[PosedStokes]) -> Measurements:
    """The data of all texels, in one row."""
    parts = (stokes.radiance, stokes.polarized, stokes.noise)
    radiance, polarized, noise = (one.reshape(len(one), -1, one.shape[-1]) for one in parts)
    return Measurements(radiance, polarized, noise, flash_light.gray_of_colors(views[0].matrix))


def resample(
    views: tuple[PosedStokes, ...], light: FlashLight, grid: TexelGrid, height: Floats, step: int
) -> TexelStokes:
    """All views on the grid, whose texels are at heights (H, W) [m] over the board, in means of step × step texels."""
    coarse = grid.coarser(step)
    shape = (len(views), coarse.size[1], coarse.size[0])
    out = TexelStokes(*(np.empty((*shape, n), np.float32) for n in (3, 2, 2)))
    point = grid.points(height)
    rows = max(_ROWS // step, 1)
    for k, view in enumerate(views):
        for top in range(0, shape[1], rows):
            strip = slice(top, min(top + rows, shape[1]))
            fine = _sample(view, light.shot_matrix[k], point[strip.start * step : strip.stop * step])
            for target, part in zip((out.radiance, out.polarized, out.noise), fine, strict=True):
                target[k, strip] = block_means(part, step)[:, : shape[2]]
        out.noise[k] /= step
    return out


def _sample(view: PosedStokes, shot_matrix: Floats, point: Floats) -> tuple[Floats, Floats, Floats]:
    """Radiance (h, w, 3), S1 and S2 (h, w, 2), and noise (h, w, 2) of a view at world points (h, w, 3) [m].

    Noise is as in `TexelStokes`: 1σ of the gray S0, and that of S1 or S2.
    """
    x, y = view.pixels(point)
    height, width = view.stokes.mask.shape
    left, right = _span(x, width)
    top, bottom = _span(y, height)
    box = (slice(top, bottom), slice(left, right))
    taps = Taps(x - left, y - top, (bottom - top, right - left))
    planes = [
        [Spline(np.ascontiguousarray(view.stokes.stokes[s][*box, c])).at(taps) for c in range(3)] for s in range(3)
    ]
    corrected = np.einsum("cst,tchw->schw", shot_matrix, np.array(planes))
    radiance = np.einsum("ij,jhw->hwi", view.matrix, corrected[0])
    weights = flash_light.gray(view.matrix)
    polarized = np.einsum("c,schw->hws", weights, corrected[1:])
    pixels = (x - left).astype(np.float32), (y - top).astype(np.float32)

    def linear(plane: Floats) -> Floats:
        return np.asarray(cv2.remap(np.ascontiguousarray(plane, np.float32), *pixels, cv2.INTER_LINEAR))

    squares = (weights**2).astype(np.float32)
    variance = [view.stokes.covariance[k][box] @ squares for k in (0, 3, 5)]  # stored are 00, 01, 02, 11, 12, 22
    s0, s1, s2 = (_SPLINE_NOISE**2 * linear(one) for one in variance)
    noise = np.sqrt(np.maximum(np.stack([s0, (s1 + s2) / 2], axis=-1), 0))
    bad = linear(np.asarray((view.stokes.quality[box] & UNKNOWN) > 0, np.float32)) > _MOST_UNKNOWN
    bad |= (x < 0) | (y < 0) | (x > width - 1) | (y > height - 1)
    noise[bad] = np.inf
    return radiance.astype(np.float32), polarized.astype(np.float32), noise


def _span(at: Floats, size: int) -> tuple[int, int]:
    """First and last pixel (exclusive) along a picture's side of `size` px around positions `at`, with a border."""
    first = int(np.clip(np.floor(at.min()) - _BORDER, 0, size - 2))
    return first, int(np.clip(np.ceil(at.max()) + _BORDER, first + 2, size))
