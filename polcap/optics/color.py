"""Color: sRGB, Rec.709, visible color differences, and the matrix of a camera.

Colors are on the last axis; white is D65 throughout. The sRGB curve and the luminance also run on torch, in training,
and the RAW reader needs the matrix before anything else is loaded: these three are not colour-science's.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics.namespace import array_namespace

# Linear Rec.709 → CIE XYZ (white: Y = 1), IEC 61966-2-1:1999.
REC709_TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], dtype=np.float64
)
LUMINANCE = REC709_TO_XYZ[1]  # Y of linear Rec.709
_RIDGE = 1e-12  # of each unknown's normal equation: too few colors leave some unknowns open, without an error
_LEVELS = 65535  # of linear light: a twentieth of an 8-bit step where the curve is steepest


def encode_srgb(linear: Any) -> Any:
    """Linear Rec.709 → sRGB, odd in its argument so that negative values survive; 1 stays 1.

    References
    ----------
    IEC 61966-2-1:1999, eq. (5)–(7).
    """
    xp = array_namespace(linear)
    size = xp.abs(linear)
    power = 1.055 * xp.where(size > 0.0031308, size, xp.ones_like(size)) ** (1 / 2.4) - 0.055
    return xp.sign(linear) * xp.where(size > 0.0031308, power, 12.92 * size)


def decode_srgb(encoded: Any) -> Any:
    """sRGB → linear Rec.709, the inverse of `encode_srgb`."""
    xp = array_namespace(encoded)
    size = xp.abs(encoded)
    return xp.sign(encoded) * xp.where(size > 0.04045, ((size + 0.055) / 1.055) ** 2.4, size / 12.92)


def srgb_eight_bits(linear: Floats) -> NDArray[np.uint8]:
    """Linear Rec.709 0…1, (..., 3) or (...,), as 8-bit sRGB, clipped; NaN becomes 0."""
    level = np.asarray(linear, np.float32) * np.float32(_LEVELS)
    level += np.float32(0.5)
    np.fmin(np.fmax(level, 0, out=level), _LEVELS, out=level)
    return _curve()[level.astype(np.uint16)]


@cache
def _curve() -> NDArray[np.uint8]:
    """sRGB of each of the levels that `srgb_eight_bits` rounds to: a look-up is ten times as fast as the power."""
    return np.asarray(np.rint(255 * encode_srgb(np.arange(_LEVELS + 1) / _LEVELS)), np.uint8)


def luminance(rgb: Any) -> Any:
    """Y of linear Rec.709 (..., 3) → (...,)."""
    return LUMINANCE[0] * rgb[..., 0] + LUMINANCE[1] * rgb[..., 1] + LUMINANCE[2] * rgb[..., 2]


def delta_e(rgb: Floats, reference: Floats) -> Floats:
    """CIEDE2000 (kL = kC = kH = 1) between linear Rec.709 colors (N, 3), or any (…, 3), white = D65; (N,).

    About 1 is just noticeable side by side.

    References
    ----------
    ISO/CIE 11664-6:2014. Sharma, Wu, Dalal, The CIEDE2000 Color-Difference Formula, Color Res. Appl. 2005.
    """
    from polcap.optics.colour_science import colour

    one, other = (colour.XYZ_to_Lab(np.asarray(c, np.float64) @ REC709_TO_XYZ.T) for c in (rgb, reference))  # of D65
    return np.asarray(colour.difference.delta_E_CIE2000(one, other))


@dataclass(frozen=True)
class MatrixFit:
    """A color matrix, with the light and residuals of its patches."""

    matrix: Floats  # (3, 3) camera channels → linear Rec.709 reflectance, where the position is 0
    slope: Floats  # (2,) relative change of the light per unit of position
    glare: float  # white light added to every patch: its gloss, the lens [reflectance]
    delta_e: Floats  # (N,) CIEDE2000; NaN for patches not used


def fit_matrix(
    color: Floats, reference: Floats, position: Floats, usable: NDArray[np.bool_], rounds: int = 20
) -> MatrixFit:
    """Least squares for a camera's matrix M under sloping light and a veil: M c = (1 + e·x) r + b (1, 1, 1).

    color and reference (N, 3) are patches in camera channels c and linear Rec.709 r, position (N, 2) their places x
    from the patch at which the matrix holds, usable (N,) the patches that serve, 12 or more.

    Notes
    -----
    A patch weighs 1/Y^⅔, the slope of L*, so that errors count as they are seen; neutral ones double.
    Huber weights take out labels and highlights. Linear in M, so it commutes with exposure.
    On 15 photographs and 4 path-traced charts the left-out patch's ΔE is 3.95 without glare, 3.57 with;
    on a chart near its highlight .97 and .09. A root-polynomial (Finlayson et al., IEEE TIP 2015) or a
    curved light gain nothing there.
    """
    matrix, slope, glare = _weighted(color, reference, position, usable, rounds)
    seen = _seen(color, position, matrix, slope, glare)
    residual = np.where(usable, delta_e(seen, reference), np.nan)
    return MatrixFit(matrix=matrix, slope=slope, glare=float(glare), delta_e=residual)


def predicted(
    color: Floats, reference: Floats, position: Floats, usable: NDArray[np.bool_], rounds: int = 20
) -> Floats:
    """CIEDE2000 (N,) of each usable patch by the matrix of all others, of 13 or more; NaN for patches not used.

    It is the error for colors that the matrix was not fitted to. Arguments as of `fit_matrix`.
    """
    left_out = np.flatnonzero(usable)
    others = usable & (np.arange(len(usable)) != left_out[:, None])
    matrix, slope, glare = _weighted(color, reference, position, others, rounds)
    each = np.arange(len(left_out))
    out = np.full(len(reference), np.nan)
    out[left_out] = delta_e(_seen(color, position, matrix, slope, glare)[each, left_out], reference[left_out])
    return out


def fitting(color: Floats, reference: Floats, position: Floats, usable: NDArray[np.bool_], tries: int = 60) -> Floats:
    """CIEDE2000 (N,) of every patch by the matrix that suits the better 60 % of the usable ones.

    A shadow's edge or a hand spoils many patches alike and attracts least squares; least trimmed squares from `tries`
    random choices of nine patches do not follow them. The choices are the same every time. Other arguments as of
    `fit_matrix`.

    References
    ----------
    Rousseeuw & Van Driessen, Computing LTS Regression for Large Data Sets, 2006.
    """
    color = color / (float(np.mean(color[usable])) + 1e-12)
    base, random, system = _base(reference), np.random.default_rng(24), _ChartEquations(color, reference, position)
    able = np.flatnonzero(usable)
    most = max(9, round(0.6 * len(able)))
    chosen = np.zeros((tries, len(base)), bool)
    for row in chosen:
        row[random.choice(able, 9, replace=False)] = True
    for _ in range(3):  # each step lowers the sum (Rousseeuw's C-step)
        seen = _seen(color, position, *system.solve(base * chosen))
        error = np.linalg.norm(base[:, None] * (seen - reference), axis=-1)
        order = able[np.argsort(error[:, able], axis=1)[:, :most]]
        chosen = np.zeros_like(chosen)
        np.put_along_axis(chosen, order, True, axis=1)
    best = int(np.argmin(np.sum(error**2, axis=1, where=chosen)))
    return delta_e(seen[best], reference)


def _weighted(
    color: Floats, reference: Floats, position: Floats, usable: NDArray[np.bool_], rounds: int
) -> tuple[Floats, Floats, Floats]:
    """M (…, 3, 3), e (…, 2) and b (…,) by least squares with Huber weights, `usable` (…, N)."""
    exposure = float(np.mean(color[usable.reshape(-1, len(color)).any(axis=0)])) + 1e-12
    color, base = color / exposure, np.where(usable, _base(reference), 0.0)
    system, weight = _ChartEquations(color, reference, position), base
    for _ in range(rounds):
        matrix, slope, glare = system.solve(weight)
        seen = _seen(color, position, matrix, slope, glare)
        error = np.linalg.norm(base[..., None] * (seen - reference), axis=-1)
        limit = 2.5 * _median(error, usable)[..., None] + 1e-9
        weight = base * np.sqrt(np.minimum(1.0, limit / np.maximum(error, 1e-12)))
    return matrix / exposure, slope, glare


def _median(value: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Median of the usable values of (…, N)."""
    ordered, count = np.sort(np.where(usable, value, np.inf), axis=-1), usable.sum(axis=-1, keepdims=True)
    middle = [np.take_along_axis(ordered, at, axis=-1)[..., 0] for at in ((count - 1) // 2, count // 2)]
    return np.asarray((middle[0] + middle[1]) / 2)


def _seen(color: Floats, position: Floats, matrix: Floats, slope: Floats, glare: Floats) -> Floats:
    """Reflectance (…, N, 3) from camera channels, the light's slope and the glare."""
    level = 1 + np.asarray(slope) @ position.T
    return np.asarray((color @ np.swapaxes(matrix, -1, -2) - np.asarray(glare)[..., None, None]) / level[..., None])


def _base(reference: Floats) -> Floats:
    """Weights (N,) by the slope of L*, neutral patches double."""
    chroma = reference.max(axis=1) - reference.min(axis=1)
    return np.asarray((1 + (chroma < 0.1 * reference.max(axis=1))) / np.maximum(luminance(reference), 0.02) ** (2 / 3))


class _ChartEquations:
    """Linear least squares over N patches × 3 channels for M, e and b, with any weights of the patches."""

    def __init__(self, color: Floats, reference: Floats, position: Floats) -> None:
        self._color, self._reference, self._position = color, reference, position
        rows = np.zeros((3, len(color), 12))
        for channel in range(3):
            rows[channel, :, 3 * channel : 3 * channel + 3] = color
            rows[channel, :, 9:11] = -position * reference[:, channel, None]
        rows[:, :, 11] = -1
        self._products = np.einsum("cni,cnj->nij", rows, rows).reshape(len(color), 144)
        self._right = np.einsum("cni,nc->ni", rows, reference)

    def solve(self, weight: Floats) -> tuple[Floats, Floats, Floats]:
        """M (…, 3, 3), e (…, 2) and b (…,) for weights (…, N)."""
        square = weight**2
        normal = (square @ self._products).reshape(*weight.shape[:-1], 12, 12)
        scale = 1 / np.sqrt(np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), 1e-30))
        alike = normal * scale[..., :, None] * scale[..., None, :] + _RIDGE * np.eye(12)
        solution = scale * np.linalg.solve(alike, (scale * (square @ self._right))[..., None])[..., 0]
        return solution[..., :9].reshape(*weight.shape[:-1], 3, 3), solution[..., 9:11], solution[..., 11]
