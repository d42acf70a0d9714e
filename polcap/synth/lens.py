"""A simulated lens: where in the undistorted picture each pixel of the photograph looks.

A ray at the angle whose tangent is t from the optical axis lands at f · (t + k₁ t³ + k₂ t⁵) from the picture's middle.
The photograph's pixels ask the other way round, which is read off a fine table of that radius.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from polcap.images import Floats, View

Bend = Annotated[float, Meta(ge=-1, le=1)]  # k₁ or k₂
_SAMPLES = 20001


def looked_at(view: View, bend: tuple[float, float], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pinhole pixels that photograph pixels x, y show, of a lens of k₁, k₂ before the pinhole `view`."""
    if not any(bend):
        return x, y
    right, down = x - view.center[0], y - view.center[1]
    landing = np.hypot(right, down) / view.focal
    tangent = np.linspace(0, 1.5 * landing.max() + 0.01, _SAMPLES)
    lands = tangent + bend[0] * tangent**3 + bend[1] * tangent**5
    rising = np.concatenate([[True], np.maximum.accumulate(lands)[:-1] < lands[1:]])
    true = np.interp(landing, lands[rising], tangent[rising])
    share = np.where(landing > 1e-9, true / np.maximum(landing, 1e-9), 1.0)
    return view.center[0] + right * share, view.center[1] + down * share
