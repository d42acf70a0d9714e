"""What a polarizer on the flash, crossed to the one before the lens, leaves of a body's light.

The flash is polarized along β, the lens's filter stands at α = β + 90°. What facets mirror keeps its axis and is
stopped. Light that enters a body of transmittances T₊ ± T₋ towards azimuth φ, and leaves it unpolarized inside, shows

    I ∝ (T₊ + T₋ cos 2(φ − β)) (T₊ + T₋ cos 2(φ − α)) = T₊² − T₋² cos² 2(φ − α)

where an unpolarized flash gives D = T₊² in S0 and p = T₊T₋ cos 2(φ − α) = S1 cos 2α + S2 sin 2α. So I = D − p²/D:
the light that is missing at steep slopes is told by the body's own polarization.

References
----------
Atkinson and Hancock, Recovery of surface orientation from diffuse polarization, IEEE TIP 2006 (T₊, T₋).
"""

import numpy as np

from polcap.images import Floats


def polarized(s1: Floats, s2: Floats, angle: float) -> Floats:
    """p = S1 cos 2α + S2 sin 2α, (H, W, C) as both are; α rad, of the lens's filter."""
    return np.asarray(s1 * np.cos(2 * angle) + s2 * np.sin(2 * angle))


def body_light(crossed: Floats, p: Floats) -> Floats:
    """D of I = D − p²/D, all (H, W, C): ½ (I + √(I² + 4 p²)); negative light, as noise can leave it, counts as none."""
    light = np.maximum(crossed, 0)
    return np.asarray((light + np.sqrt(light * light + 4 * p * p)) / 2)
