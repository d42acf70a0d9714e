"""Simulated lens distortion: the undistorted position of each pixel of a photograph.

A ray at an angle of tangent t to the optical axis reaches the sensor at the radius f · (t + k₁ t³ + k₂ t⁵). The
inverse is interpolated in a fine table of this radius.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from polcap.images import Floats, View

Bend = Annotated[float, Meta(ge=-1, le=1)]  # k₁ or k₂
_SAMPLES = 20001


def undistort(view: View, bend: tuple[float, float], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pixels of the pinhole camera `view` that see the same points as pixels x, y of a lens with k₁, k₂."""
    if not any(bend):
        return x, y
    right, down = x - view.center[0], y - view.center[1]
    radius = np.hypot(right, down) / view.focal
    tangent = np.linspace(0, 1.5 * radius.max() + 0.01, _SAMPLES)
    distorted = tangent + bend[0] * tangent**3 + bend[1] * tangent**5
    rising = np.concatenate([[True], np.maximum.accumulate(distorted)[:-1] < distorted[1:]])
    true = np.interp(radius, distorted[rising], tangent[rising])
    share = np.where(radius > 1e-9, true / np.maximum(radius, 1e-9), 1.0)
    return view.center[0] + right * share, view.center[1] + down * share
