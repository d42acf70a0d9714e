"""Cross-polarization: separates diffuse reflection by a polarizer on the lens crossed to one on the flash.

The flash is polarized along β, the axis of the lens's polarizer is α = β + 90°. Mirror reflection keeps its axis of
polarization and is blocked. Light that enters a body (transmittances T₊ ± T₋, azimuth φ), loses its polarization inside
and leaves it has the intensity

    I ∝ (T₊ + T₋ cos 2(φ − β)) (T₊ + T₋ cos 2(φ − α)) = T₊² − T₋² cos² 2(φ − α)

An unpolarized flash gives S0 = D = T₊² and p = T₊T₋ cos 2(φ − α) = S1 cos 2α + S2 sin 2α. So I = D − p²/D: the loss
of light at steep slopes follows from the Stokes parameters under an unpolarized flash.

References
----------
Atkinson and Hancock, Recovery of surface orientation from diffuse polarization, IEEE TIP 2006 (T₊, T₋).
"""

import numpy as np

from polcap.image_values import Floats


def polarization_along(s1: Floats, s2: Floats, angle: float) -> Floats:
    """Polarized part p = S1 cos 2α + S2 sin 2α (H, W, C) along the axis α = `angle` [rad] of the lens's polarizer."""
    return np.asarray(s1 * np.cos(2 * angle) + s2 * np.sin(2 * angle))


def diffuse_light(crossed: Floats, p: Floats) -> Floats:
    """Diffuse light D = ½ (I + √(I² + 4 p²)) from the cross-polarized intensity I: solves I = D − p²/D.

    All are (H, W, C). Negative I, from noise, counts as 0.
    """
    light = np.maximum(crossed, 0)
    return np.asarray((light + np.sqrt(light * light + 4 * p * p)) / 2)
