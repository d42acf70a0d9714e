"""Radial lens distortion: from pixels of a pinhole camera to pixels of the photograph, and back.

With x, y from the principal point in focal lengths and r² = x² + y², a lens images the pinhole camera's point (x, y)
at (x, y) · (1 + k₁ r² + k₂ r⁴).

References
----------
Brown, Close-range camera calibration, Photogrammetric Engineering 1971; as cv2.calibrateCamera states it.
"""

import numpy as np

from polcap.image_values import Distortion, Floats

_STEPS = 12  # of Newton's method; four are enough for any lens but a fisheye


def distort(lens: Distortion, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Map pixels x, y of a pinhole camera to pixels of the photograph; shapes broadcast, e.g. (W,), (H, 1); float64."""
    u, v = (x - lens.center[0]) / lens.focal, (y - lens.center[1]) / lens.focal
    r2 = u * u + v * v
    stretch = r2 * (lens.k1 + r2 * lens.k2) * lens.focal
    return x + u * stretch, y + v * stretch


def undistort(lens: Distortion, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Map pixels x, y (H, W) or (N,) of the photograph to pixels of a pinhole camera, by Newton's method."""
    u, v = (x - lens.center[0]) / lens.focal, (y - lens.center[1]) / lens.focal
    seen = np.hypot(u, v)
    r = seen
    for _ in range(_STEPS):
        r2 = r * r
        r = r - (r * (1 + r2 * (lens.k1 + r2 * lens.k2)) - seen) / (1 + r2 * (3 * lens.k1 + 5 * r2 * lens.k2))
    share = np.where(seen > 0, r / np.maximum(seen, 1e-12), 1.0)
    return lens.center[0] + lens.focal * u * share, lens.center[1] + lens.focal * v * share


def folds(lens: Distortion, width: float, height: float) -> bool:
    """Whether a distortion is impossible: two rays fall on one pixel, within 1.3 times this picture's size [px]."""
    x, y = (max(c, side - c) for c, side in zip(lens.center, (width, height)))
    far = np.hypot(x, y) / lens.focal
    r2 = np.linspace(0, 1.3 * far, 64) ** 2
    return not bool((1 + r2 * (3 * lens.k1 + 5 * r2 * lens.k2) > 0.05).all())  # slope of the radius; NaN folds too


def pinhole_box(lens: Distortion, box: tuple[int, int, int, int], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Box x0, y0, x1, y1 (end exclusive) of pinhole pixels that contains a box of the photograph.

    It is clipped to `size` (w, h).
    """
    x0, y0, x1, y1 = box
    across, down = np.arange(x0 - 0.5, x1), np.arange(y0 - 0.5, y1)
    x = np.concatenate([across, across, np.full(len(down), x0 - 0.5), np.full(len(down), x1 - 0.5)])
    y = np.concatenate([np.full(len(across), y0 - 0.5), np.full(len(across), y1 - 0.5), down, down])
    u, v = undistort(lens, x, y)
    left, top = max(int(np.floor(u.min() + 0.5)), 0), max(int(np.floor(v.min() + 0.5)), 0)
    right, bottom = min(int(np.ceil(u.max() + 0.5)), size[0]), min(int(np.ceil(v.max() + 0.5)), size[1])
    return left, top, right, bottom
