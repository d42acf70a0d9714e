"""The lens's light towards the corners, taken out of merged radiance."""

import numpy as np

from polcap.images import Falloff, Floats, View

_BLOCK = 64  # rows at a time


def divide(value: Floats, variance: Floats, view: View, size_px: tuple[int, int], light: Falloff) -> None:
    """Divide radiance by the light, its variance by the light's square, in place.

    Parameters
    ----------
    value, variance
        (H, W, 3), merged; written to.
    view
        Of their grid.
    size_px
        Width and height of the visible RAW; r of the law is 1 in its corners.
    light
        The lens's.
    """
    coefficient = np.broadcast_to(np.array(light.coefficient), (3, 3))
    half = np.hypot(*size_px) / 2 / view.scale  # px of this grid
    x2 = ((np.arange(value.shape[1]) - view.center[0]) / half) ** 2
    for top in range(0, len(value), _BLOCK):
        rows = slice(top, min(top + _BLOCK, len(value)))
        y2 = ((np.arange(rows.start, rows.stop) - view.center[1]) / half) ** 2
        r2 = (y2[:, None] + x2)[..., None]
        gain = (1 + r2 * (coefficient[:, 0] + r2 * (coefficient[:, 1] + r2 * coefficient[:, 2]))).astype(np.float32)
        value[rows] /= gain
        variance[rows] /= gain**2
