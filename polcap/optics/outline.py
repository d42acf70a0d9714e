"""An object's outline: how deep a pixel lies inside it, and which way is out.

Where a closed surface turns edge-on its normal points out across the outline; that is what order,
handedness and half-turns are settled by.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats


def depth(mask: NDArray[np.bool_]) -> Floats:
    """Distance of each pixel of the mask to the outline (H, W), px; the picture's edge counts as one."""
    return np.asarray(cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1])


def outward(inside: Floats, blur_px: float) -> tuple[Floats, Floats]:
    """The way out, and how clear it is.

    Parameters
    ----------
    inside
        (H, W), a mask as floats or its `depth`: larger further in. The mask tells the way near the outline
        alone, the depth everywhere.
    blur_px
        1σ of the Gaussian that rounds its pixels off first.

    Returns
    -------
    direction
        (2, H, W) unit vectors, x right, y up; zero where nothing tells.
    slope
        (H, W) of the blurred `inside` per px, times 8 (Sobel's weights).
    """
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur_px)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = np.hypot(dx, dy)
    return np.stack([-dx, dy]) / (slope + 1e-6), slope  # rows run down
