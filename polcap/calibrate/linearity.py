"""Linearity of a sensor: signal against exposure time, from flat frames in steady light."""

import numpy as np
from scipy import stats

from polcap.calibrate.calibration_photographs import Photograph, by_setting, center
from polcap.calibration_values import Linearity

_LEAST = 0.02  # of white; darker signals show the error of the black level more than a curve


def measure(flat: list[Photograph]) -> Linearity | None:
    """Measure the deviation of the sensor from linearity; None with fewer than three exposure times.

    The ISO and aperture with most exposure times are used. Shutter times have errors of one or two percent; larger
    deviations come from the sensor.
    """
    groups: dict[tuple[float, float], list[tuple[float, float]]] = {}
    for (iso, time, aperture), photographs in by_setting(flat).items():
        for one in photographs:
            mean, clipped = center(one.image())
            signal = float(mean.mean())
            if clipped == 0 and signal > _LEAST and time > 0:
                groups.setdefault((iso, aperture), []).append((time, signal))
    longest_series = max(groups.values(), key=lambda group: len({time for time, _ in group}), default=[])
    times = sorted({time for time, _ in longest_series})
    if len(times) < 3:
        return None
    exposure = np.array(times)
    light = np.array([np.mean([signal for at, signal in longest_series if at == time]) for time in times])
    gain = float(np.exp(np.mean(np.log(light / exposure))))
    deviation = light / (gain * exposure) - 1
    line = stats.linregress(np.log(exposure), np.log(light))
    return Linearity(
        greatest_deviation=float(np.abs(deviation).max()),
        power=float(line.slope),
        power_sigma=float(line.stderr),
        darkest=float(light.min()),
        brightest=float(light.max()),
        exposures=len(times),
    )
