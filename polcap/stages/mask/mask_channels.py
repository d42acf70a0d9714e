"""In: what the aligned shots measured, on a reduced grid. Out: the channels that the mask's network sees.

Logarithms of radiance and colour against the picture's own bright parts, so that exposure and light do not
matter; polarization, by which black gloss differs from black cloth; where the chart lies; what a first, coarse
look found; and where in the picture a pixel lies.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats

ENCODING = "mask 1"  # raised when a formula below changes
CHANNELS = ("log", "red", "blue", "s1", "s2", "dolp", "chart", "looked", "chance", "x", "y")
SIZE_MULTIPLE = 16  # of the network's height and width
_STOPS = 10  # of radiance below the bright parts that can be told apart
_STANDS_OUT = (0.8, 1.6)  # stops above the backdrop that make an object, however even or uneven that is
_OTHER_CHROMA = 0.15  # |Δr| + |Δg| + |Δb| of r + g + b = 1 that makes another colour
_SOFT_STOPS, _SOFT_CHROMA = 0.4, 0.04  # over which a guess turns into its contrary
_BRIGHT = 95  # percentile of the picture's radiance that counts as 1


@dataclass(frozen=True)
class Look:
    """A picture, or a part of it, on a reduced grid."""

    color: Floats  # (H, W, 3) S0 in linear Rec.709, any scale
    stokes: Floats  # (3, H, W) S0, S1, S2 summed over the camera's channels
    chart: NDArray[np.bool_]  # (H, W)
    place: Floats  # (2, H, W) x right and y down, −1…1 over the whole picture


def brightness(color: Floats) -> float:
    """The level that counts as 1: of a whole picture's S0 (H, W, 3)."""
    return max(float(np.percentile(color.mean(-1), _BRIGHT)), 1e-9)


def grid(height: int, width: int) -> Floats:
    """`Look.place` of a whole picture of this size, (2, H, W)."""
    x, y = (2 * (np.arange(n, dtype=np.float32) + 0.5) / n - 1 for n in (width, height))
    return np.stack(np.meshgrid(x, y))


def guess(look: Look) -> Floats:
    """Chance (H, W) of the object in a whole picture as far as it stands out from the backdrop at the picture's edge.

    Brighter by more than the backdrop varies, or of another color and no darker; 0 on the chart.
    """
    color = np.maximum(look.color, 0)
    log = cv2.GaussianBlur(np.log2(color.mean(-1) / brightness(color) + 2.0**-_STOPS), (0, 0), 1.0)
    rim = max(3, min(log.shape) // 20)
    edge = np.ones(log.shape, bool)
    edge[rim:-rim, rim:-rim] = False
    edge &= ~look.chart
    if not edge.any():
        return np.full_like(log, 0.5)
    level = float(np.percentile(log[edge], 40))
    spread = 1.5 * float(np.median(level - log[edge & (log <= level)]))
    chroma = color / (color.sum(-1, keepdims=True) + 1e-3 * brightness(color))
    other = np.abs(chroma - np.median(chroma[edge], axis=0)).sum(-1)
    brighter = (log - level - np.clip(4 * spread, *_STANDS_OUT)) / _SOFT_STOPS
    colored = np.where(log > level, (other - _OTHER_CHROMA) / _SOFT_CHROMA, -8)
    chance = 1 / (1 + np.exp(-np.clip(np.maximum(brighter, colored), -8, 8)))
    return np.where(look.chart, 0, chance).astype(np.float32)


def encode(look: Look, bright: float, chance: Floats | None = None) -> Floats:
    """The channels, (11, H, W) float32; `chance` (H, W) is what a first look gave each pixel of being the object.

    Without it the look is the first, at a whole picture, and `guess` stands in.
    """
    floor = 2.0**-_STOPS
    color = np.maximum(look.color, 0) / bright
    red, green, blue = np.moveaxis(np.log2(color + 2 * floor), -1, 0)
    s0, s1, s2 = look.stokes
    level = np.maximum(s0, 0) + 2 * floor * _per_color(look, bright)
    s1, s2 = (np.clip(2 * s / level, -1, 1) for s in (s1, s2))
    looked = np.zeros_like(s0) if chance is None else np.ones_like(s0)
    return np.stack(
        [
            np.log2(color.mean(-1) + floor) / _STOPS + 0.5,
            np.clip((red - green) / 3, -1, 1),
            np.clip((blue - green) / 3, -1, 1),
            s1,
            s2,
            np.sqrt(np.hypot(s1, s2)),
            look.chart.astype(np.float32),
            looked,
            2 * (guess(look) if chance is None else chance) - 1,
            *look.place,
        ]
    ).astype(np.float32)


def mirrored(channels: Floats, axes: tuple[int, ...]) -> Floats:
    """Channels (11, H, W) of the scene turned round along the image's axes, 0 y and 1 x."""
    out: Floats = np.flip(channels, tuple(1 + axis for axis in axes)).copy()
    for axis in axes:
        out[[CHANNELS.index("s2"), CHANNELS.index("yx"[axis])]] *= -1
    return out


def _per_color(look: Look, bright: float) -> float:
    """What S0 summed over the camera's channels is where the picture is bright."""
    return bright * float(look.stokes[0].clip(0).sum() / max(look.color.clip(0).mean(-1).sum(), 1e-9))
