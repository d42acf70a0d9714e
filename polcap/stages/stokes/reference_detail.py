"""Detail of the reference shot that is finer than a superpixel, from its demosaiced photosites."""

from dataclasses import replace

import cv2
import numpy as np

from polcap.image_values import Distortion, Floats, Mosaic
from polcap.optics import demosaic
from polcap.optics.resize import block_means
from polcap.optics.warp import Box, source_box, warp

_ROWS = 64  # superpixels of a block
_HALO = 3  # superpixels around a block: demosaicing reaches 3 photosites, the enlargement one superpixel
_MOST_DETAIL = 1.0  # larger values are dots of demosaicing in dark colors (docs/benchmarks/albedo.md)
_LEAST_LIGHT = np.float32(1e-6)  # so that ratios are finite


def reference_detail(mosaic: Mosaic, crop: Box, lens: Distortion | None = None) -> Floats:
    """Fine detail of the reference shot: logarithm of the light of each RAW pixel over that of the superpixels.

    The result is (2h, 2w) float16. Light is the sum of the demosaiced colors; that of the superpixels is enlarged
    linearly. `crop` (w × h) is in superpixels of the pinhole camera, and `lens` the distortion on that grid. Shading,
    gains and falloff are the same in both, so only fine detail remains.
    """
    x0, y0, x1, y1 = crop
    out = np.empty((2 * (y1 - y0), 2 * (x1 - x0)), np.float16)
    for top in range(y0, y1, _ROWS):
        bottom = min(top + _ROWS, y1)
        light = _light(mosaic, (x0 - _HALO, top - _HALO, x1 + _HALO, bottom + _HALO), lens)
        height, width = light.shape
        coarse = cv2.resize(block_means(light, 2), (width, height))
        ratio = np.maximum(light, _LEAST_LIGHT) / np.maximum(coarse, _LEAST_LIGHT)
        inner = np.s_[2 * _HALO : -2 * _HALO]
        out[2 * (top - y0) : 2 * (bottom - y0)] = np.clip(np.log(ratio[inner, inner]), -_MOST_DETAIL, _MOST_DETAIL)
    return out


def _light(mosaic: Mosaic, box: Box, lens: Distortion | None) -> Floats:
    """Sum of the demosaiced colors in a box (w × h) of superpixels, (2h, 2w); beyond the picture its edge repeats."""
    if lens is not None:
        fine = replace(lens, focal=2 * lens.focal, center=(2 * lens.center[0] + 0.5, 2 * lens.center[1] + 0.5))
        height, width = mosaic.value.shape
        source = source_box((height // 2, width // 2), np.eye(3), box, lens)
        light = _light(mosaic, source, None)
        shift = np.array([[1.0, 0, -2 * source[0]], [0, 1, -2 * source[1]], [0, 0, 1]])
        x0, y0, x1, y1 = (2 * edge for edge in box)
        return warp(light, shift, (x0, y0, x1, y1), lens=fine)
    height, width = (side // 2 for side in mosaic.value.shape)
    x0, y0, x1, y1 = box
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    photosites = mosaic.value[2 * top : 2 * bottom, 2 * left : 2 * right].astype(np.float32)
    light = demosaic.interpolate(photosites, mosaic.cfa).sum(axis=-1)
    edges = 2 * (top - y0), 2 * (y1 - bottom), 2 * (left - x0), 2 * (x1 - right)
    return np.asarray(cv2.copyMakeBorder(light, *edges, cv2.BORDER_REPLICATE))
