"""Resample an image through a projective transform with cubic splines.

A cubic spline reproduces ramps and parabolas exactly, so a shift comes out as a shift. OpenCV's cubic
kernel (a = −0.75) does not: it moves a ramp by up to 0.05 px, which is the whole budget of registration.

References
----------
Thévenaz, Blu, Unser, Interpolation revisited, IEEE TMI 2000.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polcap.images import Floats

Bools = NDArray[np.bool_]


def warp(
    image: Floats, transform: Floats, box: tuple[int, int, int, int] | None = None, order: Literal[1, 3] = 3
) -> Floats:
    """image∘transform over `box`, float32.

    Parameters
    ----------
    image : (H, W) or (H, W, C).
    transform : (3, 3), output px (x, y, 1) → image px, homogeneous.
    box : x0, y0, x1, y1 of the output in its own px (end exclusive); the image's own frame by default.
    order : 3 for values, 1 for weights and masks. Outside the image the edge is repeated.
    """
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    if image.ndim == 3:
        planes = [warp(image[..., c], transform, (x0, y0, x1, y1), order) for c in range(image.shape[2])]
        return np.stack(planes, axis=-1)
    shape = (int(y1 - y0), int(x1 - x0))
    if np.array_equal(transform, np.eye(3)) and x0 >= 0 and y0 >= 0 and x1 <= image.shape[1] and y1 <= image.shape[0]:
        return np.asarray(image[y0:y1, x0:x1], dtype=np.float32)
    h = np.asarray(transform, dtype=np.float64)
    if abs(h[2, 0]) + abs(h[2, 1]) < 1e-15:
        matrix: NDArray[np.float64] = np.array([[h[1, 1], h[1, 0]], [h[0, 1], h[0, 0]]]) / h[2, 2]
        offset: NDArray[np.float64] = np.array([h[1, 2], h[0, 2]]) / h[2, 2] + matrix @ np.array([y0, x0])
        source = np.asarray(image, np.float32)
        result = np.empty(shape, np.float32)
        ndimage.affine_transform(source, matrix, tuple(offset), output=result, order=order, mode="nearest")
    else:
        y, x = np.mgrid[y0:y1, x0:x1].astype(np.float64)
        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        at = np.stack([(h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w, (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w])
        result = np.asarray(ndimage.map_coordinates(np.asarray(image, np.float32), at, order=order, mode="nearest"))
    return result


def covered(shape: tuple[int, int], transform: Floats, box: tuple[int, int, int, int], margin: float = 1.0) -> Bools:
    """(h, w) bool: which pixels of `box` fall inside an image of `shape`, at least `margin` px from its edge."""
    x0, y0, x1, y1 = box
    y, x = np.mgrid[y0:y1, x0:x1].astype(np.float64)
    h = np.asarray(transform, dtype=np.float64)
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    u, v = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
    inside = (u >= margin) & (v >= margin) & (u <= shape[1] - 1 - margin) & (v <= shape[0] - 1 - margin)
    return np.asarray(inside)
