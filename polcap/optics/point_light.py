"""In: points, and a flash beside the lens. Out: how much of its light a camera sees arrive there."""

import numpy as np

from polcap.images import Floats


def irradiance(point: Floats, flash: Floats, power: float, normal: Floats | None = None) -> Floats:
    """Irradiance (...,) at points (..., 3) of the camera frame, 1 on the axis at distance 1: n·l / d² · cosᵖ θ.

    The last factor, over the angle θ to the optical axis, stands for a lens that is dark in the corners and for a beam
    that is bright in the middle.

    Parameters
    ----------
    point
        Where.
    flash
        (2,) right of the lens and above it, in the points' unit.
    power
        p of the falloff; 0 of none.
    normal
        (3,) of the plane there; None where it faces the flash.
    """
    to_light = np.append(flash, 0.0) - point
    squared = np.sum(to_light**2, axis=-1)
    facing = 1.0 if normal is None else np.maximum(to_light @ normal, 0.0) / np.sqrt(squared)
    lens = -point[..., 2] / np.linalg.norm(point, axis=-1)
    return np.asarray(facing / squared * lens**power)
