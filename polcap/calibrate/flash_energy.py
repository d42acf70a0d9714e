"""Variation of the flash energy: random spread and drift between flashes, from photographs of one motionless scene."""

import numpy as np

from polcap.calibrate.calibration_photographs import Photograph, by_setting, exposed_center
from polcap.calibration_values import FlashEnergy
from polcap.errors import CaptureError

_LEAST = 4  # flashes


def measure(photographs: list[Photograph]) -> FlashEnergy:
    """Measure spread (1σ relative to the mean) and drift of the flash energy, in the largest series of equal settings.

    Raises CaptureError for fewer than four frames of one setting, or over-exposed ones.
    """
    group = max(by_setting(photographs).values(), key=len)
    if len(group) < _LEAST:
        raise CaptureError(
            f"{group[0].path.parent}: {len(group)} frames of one setting; take {_LEAST} or more, "
            "twenty give the spread to 16 %"
        )
    light = [float(exposed_center(one).mean()) for one in group]
    energy = np.array(light) / np.mean(light)
    order = np.arange(len(energy)) - (len(energy) - 1) / 2  # about the middle
    drift = float(order @ energy / (order @ order))
    spread = float(np.std(energy - drift * order, ddof=2))
    return FlashEnergy(
        spread=spread,
        spread_sigma=spread / float(np.sqrt(2 * (len(energy) - 2))),  # two unknowns: mean and drift
        drift_per_pop=drift,
        drift_sigma=spread / float(np.sqrt(order @ order)),
        pops=len(energy),
    )
