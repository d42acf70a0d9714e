"""A pinhole camera's pixels in, where the lens put them out, and back.

With x, y from the principal point in focal lengths and r² = x² + y², a lens puts what belongs to (x, y) at
(x, y) · (1 + k₁ r² + k₂ r⁴).

References
----------
Brown, Close-range camera calibration, Photogrammetric Engineering 1971; as cv2.calibrateCamera states it.
"""

import numpy as np

from polcap.images import Distortion, Floats

_STEPS = 12  # of Newton's method; four are enough for any lens that is no fisheye


def distorted(lens: Distortion, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pixels of the picture that show what belongs to pinhole pixels x (W,), y (H, 1) or alike; float64."""
    u, v = (x - lens.center[0]) / lens.focal, (y - lens.center[1]) / lens.focal
    r2 = u * u + v * v
    stretch = r2 * (lens.k1 + r2 * lens.k2) * lens.focal
    return x + u * stretch, y + v * stretch


def undistorted(lens: Distortion, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The inverse of `distorted`, for x, y (H, W) or (N,), along each radius by Newton's method."""
    u, v = (x - lens.center[0]) / lens.focal, (y - lens.center[1]) / lens.focal
    seen = np.hypot(u, v)
    r = seen
    for _ in range(_STEPS):
        r2 = r * r
        r = r - (r * (1 + r2 * (lens.k1 + r2 * lens.k2)) - seen) / (1 + r2 * (3 * lens.k1 + 5 * r2 * lens.k2))
    share = np.where(seen > 0, r / np.maximum(seen, 1e-12), 1.0)
    return lens.center[0] + lens.focal * u * share, lens.center[1] + lens.focal * v * share


def folds(lens: Distortion, width: float, height: float) -> bool:
    """Whether within a picture of that size two rays fall on one pixel: no lens does."""
    x, y = (max(c, side - c) for c, side in zip(lens.center, (width, height)))
    far = np.hypot(x, y) / lens.focal
    r2 = np.linspace(0, 1.3 * far, 64) ** 2
    return not bool((1 + r2 * (3 * lens.k1 + 5 * r2 * lens.k2) > 0.05).all())  # so that NaN folds


def box_of(lens: Distortion, box: tuple[int, int, int, int], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """The pinhole pixels x0, y0, x1, y1 (end exclusive) that show all of a box of the picture; within size (w, h)."""
    x0, y0, x1, y1 = box
    across, down = np.arange(x0 - 0.5, x1), np.arange(y0 - 0.5, y1)
    x = np.concatenate([across, across, np.full(len(down), x0 - 0.5), np.full(len(down), x1 - 0.5)])
    y = np.concatenate([np.full(len(across), y0 - 0.5), np.full(len(across), y1 - 0.5), down, down])
    u, v = undistorted(lens, x, y)
    left, top = max(int(np.floor(u.min() + 0.5)), 0), max(int(np.floor(v.min() + 0.5)), 0)
    right, bottom = min(int(np.ceil(u.max() + 0.5)), size[0]), min(int(np.ceil(v.max() + 0.5)), size[1])
    return left, top, right, bottom
