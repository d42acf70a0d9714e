"""Demosaicing: from one color per photosite to three per pixel, by superpixel binning or linear interpolation.

Both are linear and the same for every picture. So they add no polarization, and a pixel's variance follows from the
variances of its photosites. A color filter array (CFA) is a (2, 2) array of 0 R, 1 G, 2 B. X-Trans has (6, 6), binned
in blocks of 3×3: green in the corners and the middle, two reds and two blues on opposite sides. The centroid of each
color is then the middle of the block.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from polcap.image_values import Bits, Floats


def superpixel(mosaic: Any, cfa: Bits) -> Floats:
    """Bin a mosaic to color planes, (H, W) → (3, H//n, W//n): one pixel per 2×2 quad, or per 3×3 block of X-Trans.

    Rows and columns after the last whole block are dropped.
    """
    period = len(cfa)
    side, blocks = (2, 1) if period == 2 else (3, 2)  # of a block; blocks per period
    h, w = mosaic.shape[0] // side, mosaic.shape[1] // side
    out = np.zeros((3, h, w), np.float32)
    for i, j in np.ndindex(period, period):
        out[cfa[i, j], i // side :: blocks, j // side :: blocks] += mosaic[i : side * h : period, j : side * w : period]
    for color, plane in enumerate(out):
        plane *= np.float32(blocks**2 / np.sum(cfa == color))  # one over the photosites per color and block
    return out


def x_trans_corner(cfa: Bits) -> tuple[int, int] | None:
    """Row and column of the first 3×3 block in a (6, 6) X-Trans CFA; None for another mosaic."""
    for down, right in np.ndindex(3, 3):
        moved = np.roll(cfa, (-down, -right), (0, 1))
        blocks = moved.reshape(2, 3, 2, 3).transpose(0, 2, 1, 3).reshape(4, 9)
        sides = blocks[:, 1::2]  # above, left, right, below
        alike = (sides[:, 0] == sides[:, 3]) & (sides[:, 1] == sides[:, 2])
        red_and_blue = (sides != 1).all() and (sides[:, 0] + sides[:, 1] == 2).all()
        if (blocks[:, ::2] == 1).all() and alike.all() and red_and_blue:
            return down, right
    return None


def interpolate(mosaic: Floats, cfa: Bits) -> Floats:
    """Demosaic to all three colors at every photosite, (H, W) → (H, W, 3) float32.

    Green is the mean of its four neighbors, corrected by the curvature of the color measured there. Red and blue are
    interpolated bilinearly as differences from green. Measured values stay unchanged.

    References
    ----------
    Hamilton and Adams, US patent 5,629,734 (1997, expired), both directions averaged.
    """
    m = np.asarray(mosaic, np.float32)
    p = np.pad(m, 2, mode="reflect")  # keeps the phase of the CFA
    green = (p[1:-3, 2:-2] + p[3:-1, 2:-2] + p[2:-2, 1:-3] + p[2:-2, 3:-1]) / 4  # above, below, left, right
    far = p[:-4, 2:-2] + p[4:, 2:-2] + p[2:-2, :-4] + p[2:-2, 4:]  # the same at two pixels
    green += (4 * m - far) / 8
    for i, j in np.argwhere(cfa == 1):
        green[i::2, j::2] = m[i::2, j::2]
    out = np.empty((*m.shape, 3), np.float32)
    out[..., 1] = green
    for color in (0, 2):
        sparse = np.zeros_like(m)
        for i, j in np.argwhere(cfa == color):
            sparse[i::2, j::2] = m[i::2, j::2] - green[i::2, j::2]
        p = np.pad(sparse, 1, mode="reflect")
        rows = p[:-2] + 2 * p[1:-1] + p[2:]
        out[..., color] = green + (rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 4
    return out


def variance_gain(cfa: Bits) -> Floats:
    """Noise gain of `interpolate`, (2, 2, 3, 3) = [row phase, column phase, output color, input color].

    Variance of an output color = Σ over input colors of gain · variance of one such photosite.
    """
    return _variance_gain(tuple(int(c) for c in np.ravel(cfa)))


@lru_cache(maxsize=8)
def _variance_gain(colors: tuple[int, ...]) -> Floats:
    """As `variance_gain`, from the demosaiced response to an impulse at each photosite."""
    cfa = np.array(colors, np.uint8).reshape(2, 2)
    size, middle = 16, 8
    gain = np.zeros((2, 2, 3, 3), np.float32)
    for i, j in np.ndindex(size, size):
        impulse = np.zeros((size, size), np.float32)
        impulse[i, j] = 1
        response = interpolate(impulse, cfa)[middle : middle + 2, middle : middle + 2]
        gain[..., cfa[i % 2, j % 2]] += response**2
    return gain
