"""Mueller calculus of a linear polarizer: the share of each Stokes parameter that it transmits.

Signs: angles run from image x towards image up, counter-clockwise in the picture. So S1 > 0 is horizontal and
S2 > 0 is 45° up-right. Works on NumPy and torch.
"""

from typing import Any

from polcap.optics.namespace import array_namespace


def analyzer(angle: Any, extinction_ratio: float = float("inf")) -> Any:
    """Weights with which a linear polarizer transmits (S0, S1, S2): intensity = weights · Stokes parameters.

    Rows ½ (1, c cos 2θ, c sin 2θ), (..., 3), for axes θ (...,) rad, with c = (E − 1)/(E + 1) for an extinction ratio E,
    and c = 1 for an ideal polarizer. A real polarizer transmits a constant factor less, which the white balance
    absorbs.

    References
    ----------
    Collett, Polarized Light, ch. 5 eq. (13).
    """
    xp = array_namespace(angle)
    contrast = 1.0 if extinction_ratio == float("inf") else (extinction_ratio - 1) / (extinction_ratio + 1)
    one = xp.ones_like(angle)
    return 0.5 * xp.stack([one, contrast * xp.cos(2 * angle), contrast * xp.sin(2 * angle)], axis=-1)
