"""Irradiance by a point light near the lens, with the falloff of lens and beam towards the corners."""

import numpy as np

from polcap.image_values import Floats


def irradiance(point: Floats, flash: Floats, power: float, normal: Floats | None = None) -> Floats:
    """Irradiance (...,) at points (..., 3) of the camera frame: n·l / d² · cosᵖ θ, 1 on the axis at distance 1.

    cosᵖ θ is the falloff of lens and beam, with θ the angle to the optical axis and p = `power`; none for p = 0. flash
    (2,) is the position of the light right of the lens and above it, in the unit of the points. normal (3,) is that of
    a plane; None: every surface faces the light.
    """
    to_light = np.append(flash, 0.0) - point
    squared = np.sum(to_light**2, axis=-1)
    facing = 1.0 if normal is None else np.maximum(to_light @ normal, 0.0) / np.sqrt(squared)
    cosine = -point[..., 2] / np.linalg.norm(point, axis=-1)
    return np.asarray(facing / squared * cosine**power)
