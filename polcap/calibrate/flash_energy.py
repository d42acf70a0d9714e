"""In: one thing photographed again and again by the flash. Out: how far its energy scatters from pop to pop."""

import numpy as np

from polcap.calibrate.photographs import Photograph, by_setting, center
from polcap.errors import CaptureError
from polcap.images import FlashEnergy

_LEAST = 4  # pops, for a spread that means something
_CLIPPED = 0.01


def measure(photographs: list[Photograph]) -> FlashEnergy:
    """1σ of the energy relative to its mean, its own 1σ, and the drift over the series; of the largest equal series.

    Raises
    ------
    CaptureError
        Fewer than four frames of one setting, or over-exposed ones.
    """
    group = max(by_setting(photographs).values(), key=len)
    if len(group) < _LEAST:
        raise CaptureError(
            f"{group[0].path.parent}: {len(group)} frames of one setting; take {_LEAST} or more, "
            "twenty tell the spread to 16 %"
        )
    light = []
    for one in group:
        mean, clipped = center(one.image())
        if clipped > _CLIPPED:
            raise CaptureError(f"{one.path}: {100 * clipped:.0f} % of its middle is over-exposed; take less light")
        light.append(float(mean.mean()))
    energy = np.array(light) / np.mean(light)
    order = np.arange(len(energy)) - (len(energy) - 1) / 2
    drift = float(order @ energy / (order @ order))
    spread = float(np.std(energy - drift * order, ddof=2))
    return FlashEnergy(
        spread=spread,
        spread_sigma=spread / float(np.sqrt(2 * (len(energy) - 2))),
        drift_per_pop=drift,
        drift_sigma=spread / float(np.sqrt(order @ order)),
        pops=len(energy),
    )
