"""Where a frame of a bracket moved to against the reference frame, and its signals taken back from there."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import CaptureError
from polcap.images import Floats
from polcap.optics.registration import Pyramid, register
from polcap.stages.hdr.planes import Planes, Signals, blocks

Bools = NDArray[np.bool_]

_SMOOTH = cv2.getGaussianKernel(7, 0.8, cv2.CV_32F)
_STILL_PX = 0.05  # less motion than this is not worth a resampling


def view(signals: Signals) -> Pyramid:
    """The square root of all channels together, lightly smoothed: about even noise."""
    _, height, width = signals.shape
    out = np.empty((height, width), np.float32)
    for rows, inner, target in blocks(height, _SMOOTH.size // 2):
        total, *others = signals.rows(rows)
        for plane in others:
            total = total + plane
        smooth = np.asarray(cv2.sepFilter2D(total, -1, _SMOOTH, _SMOOTH))[inner]
        np.maximum(smooth, 0, out=smooth)
        smooth += np.float32(1e-4)
        np.sqrt(smooth, out=out[target])
    return Pyramid(out, signals.usable)


def moved(name: str, still: Pyramid, other: Pyramid, limit_px: float) -> Floats | None:
    """Reference px → frame px (3, 3), or None where the frame did not move measurably.

    Parameters
    ----------
    name
        Of the frame, for the message.
    still, other
        Views of the reference frame and of the frame.
    limit_px
        Accepted motion, px of the views.

    Raises
    ------
    CaptureError
        It moved by more.
    """
    found = register(still, other)
    if found.shift_px > limit_px:
        raise CaptureError(
            f"{name} moved by {found.shift_px:.0f} px against the bracket's reference frame, more than "
            f"{limit_px:.0f}: use a tripod, or raise hdr.max_motion_px"
        )
    return found.matrix if found.shift_px > max(_STILL_PX, 3 * found.sigma_px) else None


def resampled(signals: Signals, matrix: Floats) -> tuple[Planes, Floats]:
    """A frame on the reference frame's grid (Lanczos), and its noise variance gain (H, W)."""
    _, h, w = signals.shape
    inverse = cv2.WARP_INVERSE_MAP
    value = np.stack(
        [
            cv2.warpPerspective(
                plane, matrix, (w, h), flags=inverse | cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
            )
            for plane in signals.rows(slice(0, h))
        ]
    )
    # no clipped pixel, nor the border, within the main lobes of the kernel
    inner = cv2.erode(signals.usable.view(np.uint8) * 255, np.ones((5, 5), np.uint8), borderValue=0)
    seen = cv2.warpPerspective(inner, matrix, (w, h), flags=inverse | cv2.INTER_LINEAR, borderValue=0) == 255
    gain = np.empty((h, w), np.float32)
    table = _kernel_gain()
    x = np.arange(w, dtype=np.float32)
    m = matrix.astype(np.float32)
    for rows, _, _ in blocks(h):
        y = np.arange(h, dtype=np.float32)[rows, None]
        depth = m[2, 0] * x + (m[2, 1] * y + m[2, 2])
        px = (m[0, 0] * x + (m[0, 1] * y + m[0, 2])) / depth
        py = (m[1, 0] * x + (m[1, 1] * y + m[1, 2])) / depth
        gain[rows] = table[((px - np.floor(px)) * 32 + 0.5).astype(np.int8)]
        gain[rows] *= table[((py - np.floor(py)) * 32 + 0.5).astype(np.int8)]
    return Planes(value, seen), gain


def on_full(matrix: Floats) -> Floats:
    """A homography (3, 3) between binned grids, between the full ones."""
    full = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    return np.asarray(full @ matrix @ np.linalg.inv(full))


@lru_cache(maxsize=1)
def _kernel_gain() -> Floats:
    """Σ of squared weights of cv2's Lanczos kernel at fractions 0, 1/32 … 1 of a pixel, (33,)."""
    impulse = np.zeros((17, 33), np.float32)
    impulse[:, 16] = 1
    x = np.arange(33, dtype=np.float32)[None] + np.arange(33, dtype=np.float32)[:, None] / 32
    row = cv2.remap(impulse, x, np.full_like(x, 8), cv2.INTER_LANCZOS4)
    return np.asarray(np.sum(row.astype(np.float64) ** 2, axis=1), np.float32)
