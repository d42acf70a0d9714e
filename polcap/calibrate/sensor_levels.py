"""Black and white level of a sensor, from dark frames and over-exposed flat frames."""

import numpy as np

from polcap.calibrate.calibration_photographs import Photograph
from polcap.calibration_values import Levels
from polcap.errors import CaptureError
from polcap.image_values import SensorImage
from polcap.optics import sensor

_DARK = 0.05  # of white; a frame with more light is not dark


def measure(dark: list[Photograph], bright: list[Photograph]) -> Levels:
    """Measure the black level of each photosite of the mosaic's pattern, and the saturated count, if frames saturate.

    Raises CaptureError if a dark frame is not dark.
    """
    means, noise = [], []
    for one in dark:
        image = one.image()
        rows, columns = (1, 1) if image.cfa is None else image.cfa.shape
        phases = [image.value[i::rows, j::columns] for i in range(rows) for j in range(columns)]
        mean = [float(phase.mean(dtype=np.float64)) for phase in phases]
        stated = np.broadcast_to(image.black, (rows, columns)).ravel()
        if max(mean) - float(stated.max()) > _DARK * (image.white - float(stated.max())):
            raise CaptureError(
                f"{one.path}: the mean count is {max(mean):.0f}, but black is {stated.max():.0f}; "
                "take dark frames with the cap on"
            )
        means.append(mean)
        noise.append([float(phase.std(dtype=np.float64)) / np.sqrt(phase.size) for phase in phases])
    black = np.mean(means, axis=0)
    sigma = np.hypot(np.mean(noise, axis=0), np.std(means, axis=0, ddof=1) if len(means) > 1 else 0.0)
    saturated = [(sensor.saturation(image), image.white) for image in (one.image() for one in bright) if _clips(image)]
    return Levels(
        black=tuple(black.tolist()),
        black_sigma=tuple((sigma / np.sqrt(len(means))).tolist()),
        black_stated=tuple(stated.tolist()),
        white=min((level for level, _ in saturated), default=None),
        white_stated=float(image.white),
    )


def _clips(image: SensorImage) -> bool:
    """Whether a photograph is saturated: more than 0.1 % of its counts are the greatest, over 60 % of white."""
    greatest = image.value.max()
    return bool(np.mean(image.value == greatest) > 1e-3 and greatest > 0.6 * image.white)
