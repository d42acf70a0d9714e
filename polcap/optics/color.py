"""Color: the sRGB curve, luminance and CIEDE2000 differences.

Colors are on the last axis; white is D65 throughout. The sRGB curve and the luminance also run on torch, in training,
and the RAW reader needs REC709_TO_XYZ without a long import: these three do not come from colour-science.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats
from polcap.optics.namespace import array_namespace

# Linear Rec.709 → CIE XYZ (white: Y = 1), IEC 61966-2-1:1999.
REC709_TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], dtype=np.float64
)
LUMINANCE = REC709_TO_XYZ[1]  # Y of linear Rec.709
_LEVELS = 65535  # of linear light; one is 1/20 of an 8-bit step where the curve is steepest


def encode_srgb(linear: Any) -> Any:
    """Encode linear Rec.709 as sRGB. An odd function, so negative values stay negative; 1 → 1.

    References
    ----------
    IEC 61966-2-1:1999, eq. (5)–(7).
    """
    xp = array_namespace(linear)
    size = xp.abs(linear)
    power = 1.055 * xp.where(size > 0.0031308, size, xp.ones_like(size)) ** (1 / 2.4) - 0.055
    return xp.sign(linear) * xp.where(size > 0.0031308, power, 12.92 * size)


def decode_srgb(encoded: Any) -> Any:
    """Decode sRGB to linear Rec.709: the inverse of `encode_srgb`."""
    xp = array_namespace(encoded)
    size = xp.abs(encoded)
    return xp.sign(encoded) * xp.where(size > 0.04045, ((size + 0.055) / 1.055) ** 2.4, size / 12.92)


def srgb_eight_bits(linear: Floats) -> NDArray[np.uint8]:
    """Encode linear Rec.709 0…1, (..., 3) or (...,), as 8-bit sRGB, clipped; NaN becomes 0."""
    level = np.asarray(linear, np.float32) * np.float32(_LEVELS)
    level += np.float32(0.5)
    np.fmin(np.fmax(level, 0, out=level), _LEVELS, out=level)
    return _curve()[level.astype(np.uint16)]


@cache
def _curve() -> NDArray[np.uint8]:
    """Look-up table of 8-bit sRGB for linear levels, for `srgb_eight_bits`; ten times as fast as the power function."""
    return np.asarray(np.rint(255 * encode_srgb(np.arange(_LEVELS + 1) / _LEVELS)), np.uint8)


def luminance(rgb: Any) -> Any:
    """Luminance Y (...,) of linear Rec.709 colors (..., 3)."""
    return LUMINANCE[0] * rgb[..., 0] + LUMINANCE[1] * rgb[..., 1] + LUMINANCE[2] * rgb[..., 2]


def delta_e(rgb: Floats, reference: Floats) -> Floats:
    """CIEDE2000 difference (…,) between linear Rec.709 colors (…, 3), kL = kC = kH = 1, white D65.

    About 1 is just noticeable between adjacent colors.

    References
    ----------
    ISO/CIE 11664-6:2014. Sharma, Wu, Dalal, The CIEDE2000 Color-Difference Formula, Color Res. Appl. 2005.
    """
    from polcap.optics.colour_science import colour

    one, other = (colour.XYZ_to_Lab(np.asarray(c, np.float64) @ REC709_TO_XYZ.T) for c in (rgb, reference))  # of D65
    return np.asarray(colour.difference.delta_E_CIE2000(one, other))
