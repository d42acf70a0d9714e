"""Input channels of the mask network: log radiance, color, polarization, chart, previous estimate, position.

Radiance is relative to the picture's bright parts, so the input does not depend on exposure and light. Polarization
distinguishes black gloss from black cloth.
"""

from dataclasses import dataclass

import numpy as np

from polcap.image_values import Bools, Floats
from polcap.stages.mask import backdrop
from polcap.stages.mask.backdrop import STOPS, brightness

__all__ = ["CHANNELS", "ENCODING", "SIZE_MULTIPLE", "ReducedPicture", "brightness", "encode", "grid", "mirror"]

ENCODING = "mask 1"  # changed with every formula below
# names in the model files; "looked": an estimate of the network is given, "chance": the estimated probability
CHANNELS = ("log", "red", "blue", "s1", "s2", "dolp", "chart", "looked", "chance", "x", "y")
SIZE_MULTIPLE = 16  # the network's height and width are multiples of this


@dataclass(frozen=True)
class ReducedPicture:
    """A picture, or a part of it, averaged down for the mask network."""

    color: Floats  # (H, W, 3) S0 in linear Rec.709, any scale
    stokes: Floats  # (3, H, W) S0, S1, S2 summed over the camera's channels
    chart: Bools  # (H, W)
    place: Floats  # (2, H, W) position: x right and y down, −1…1 over the whole picture


def grid(height: int, width: int) -> Floats:
    """Positions x, y (2, H, W), −1…1, of the pixels of a whole picture; see `ReducedPicture.place`."""
    x, y = (2 * (np.arange(n, dtype=np.float32) + 0.5) / n - 1 for n in (width, height))
    return np.stack(np.meshgrid(x, y))


def encode(picture: ReducedPicture, bright: float, estimate: Floats | None = None) -> Floats:
    """Compute the mask network's input channels (11, H, W) float32 from a picture and an estimate of the mask.

    `estimate` (H, W) is the probability of being the object, from an earlier pass. Without it the picture must be
    whole; its difference from the backdrop is then the estimate. `bright` is the `brightness` of the whole picture.
    """
    floor = 2.0**-STOPS
    color = np.maximum(picture.color, 0) / bright
    red, green, blue = np.moveaxis(np.log2(color + 2 * floor), -1, 0)
    s0, s1, s2 = picture.stokes
    s0_level = np.maximum(s0, 0) + 2 * floor * _bright_s0(picture, bright)
    s1, s2 = (np.clip(2 * s / s0_level, -1, 1) for s in (s1, s2))
    by_network = np.zeros_like(s0) if estimate is None else np.ones_like(s0)
    if estimate is None:
        estimate = backdrop.probability(picture.color, picture.chart)
    return np.stack(
        [
            np.log2(color.mean(-1) + floor) / STOPS + 0.5,
            np.clip((red - green) / 3, -1, 1),
            np.clip((blue - green) / 3, -1, 1),
            s1,
            s2,
            np.sqrt(np.hypot(s1, s2)),
            picture.chart.astype(np.float32),
            by_network,
            2 * estimate - 1,
            *picture.place,
        ]
    ).astype(np.float32)


def mirror(channels: Floats, axes: tuple[int, ...]) -> Floats:
    """Mirror the mask network's channels (11, H, W) along axes of the picture: 0 y, 1 x."""
    out: Floats = np.flip(channels, tuple(1 + axis for axis in axes)).copy()
    for axis in axes:
        out[[CHANNELS.index("s2"), CHANNELS.index("yx"[axis])]] *= -1
    return out


def _bright_s0(picture: ReducedPicture, bright: float) -> float:
    """Convert `bright`, a level of the mean of R, G and B, to the level of S0 summed over the camera's channels."""
    return bright * float(picture.stokes[0].clip(0).sum() / max(picture.color.clip(0).mean(-1).sum(), 1e-9))
