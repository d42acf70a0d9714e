"""The camera run forwards: radiance per channel -> the counts of a colour mosaic, with noise and clipping.

References
----------
Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010, §3.
"""

from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.images import Bits, Floats


class Sensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pixel at base sensitivity."""

    full_well: Annotated[float, Meta(gt=0, le=1e9)] = 30000.0  # e⁻ at the white level
    read_noise: Annotated[float, Meta(ge=0, le=1e6)] = 3.0  # e⁻, 1σ
    black: Annotated[int, Meta(ge=0, lt=65535)] = 512  # counts
    white: Annotated[int, Meta(gt=0, le=65535)] = 15871  # counts


def mosaic(image: Floats, cfa: Bits) -> Floats:
    """Every pixel of (H, W, 3) through its own colour filter, (H, W); cfa (n, n) of 0 R, 1 G, 2 B."""
    out = np.empty(image.shape[:2], image.dtype)
    period = len(cfa)
    for row, column in np.ndindex(period, period):
        out[row::period, column::period] = image[row::period, column::period, cfa[row, column]]
    return out


def expose(radiance: Floats, sensor: Sensor, amplification: float, random: np.random.Generator) -> NDArray[np.uint16]:
    """Counts of a mosaic whose radiance 1 fills the well at base sensitivity.

    Photons are Poisson, read noise is Gaussian, counts are rounded and clipped to 0…white; the well
    saturates too. `amplification` is 1 at base sensitivity (ISO 100), 2 a stop up.
    """
    electrons: NDArray[Any] = random.poisson(np.maximum(radiance, 0.0) * sensor.full_well).astype(np.float64)
    electrons = np.minimum(electrons, sensor.full_well) + random.normal(0.0, sensor.read_noise, radiance.shape)
    counts = sensor.black + electrons * amplification * (sensor.white - sensor.black) / sensor.full_well
    return np.clip(np.rint(counts), 0, sensor.white).astype(np.uint16)
