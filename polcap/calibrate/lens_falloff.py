"""Light falloff of a lens towards the corners, from flat frames; 1 in the middle.

The light on the surface is never quite even, so its linear slope is fitted together with the radial falloff.
"""

import numpy as np

from polcap.calibrate.calibration_photographs import CLIP, Photograph, by_setting
from polcap.calibration_values import Falloff
from polcap.errors import CaptureError
from polcap.image_values import Floats
from polcap.optics import sensor
from polcap.optics.resize import area_mean

_CELLS = 48  # means of the picture, along its longer side
_FAINT = 0.02  # of white; darker frames show noise and the error of the black level


def measure(flat: list[Photograph]) -> Falloff:
    """Measure the light falloff of the lens, 1 + a r² + b r⁴ + c r⁶ per channel, r = 1 in the corners.

    The flat frames of the brightest setting that does not clip are used.

    Raises CaptureError if every flat frame is clipped or dark.
    """
    groups = sorted(by_setting(flat).values(), key=lambda one: one[0].exif.relative_exposure or 0.0, reverse=True)
    for group in groups:
        images = [one.image() for one in group]
        if all(sensor.usable(image, CLIP).mean() > 0.999 for image in images):  # of the pixels
            mean = np.mean([sensor.signal(image) for image in images], axis=0)
            if mean.mean() > _FAINT:
                break
    else:
        raise CaptureError(f"{flat[0].path.parent}: every flat frame is clipped or dark; expose to half of white")
    coefficient, sigma = _fit(mean)
    return Falloff(
        coefficient=tuple(map(tuple, coefficient.tolist())),
        sigma=tuple(map(tuple, sigma.tolist())),
        corner=tuple((1 + coefficient.sum(axis=1)).tolist()),
        f_number=group[0].exif.f_number,
        focal_length_mm=group[0].exif.focal_length_mm,
    )


def _fit(picture: Floats) -> tuple[Floats, Floats]:
    """Fit the falloff to a flat frame (H, W, C): coefficients (C, 3) and their 1σ (C, 3)."""
    h, w = picture.shape[:2]
    width, height = (max(4, round(_CELLS * side / max(h, w))) for side in (w, h))
    cells = area_mean(np.asarray(picture, np.float32), (height, width)).reshape(height * width, -1)
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1) + 0.5
    x, y = (x / width - 0.5) * w, (y / height - 0.5) * h
    half = np.hypot(w, h) / 2
    r2 = (x**2 + y**2) / half**2
    matrix = np.stack([np.ones_like(x), x / half, y / half, r2, r2**2, r2**3], axis=1)
    solved, _, _, _ = np.linalg.lstsq(matrix, cells, rcond=None)
    residual = cells - matrix @ solved
    variance = (residual**2).sum(axis=0) / (len(cells) - 6)  # six unknowns
    sigma = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix))[3:, None] * variance)
    return (solved[3:] / solved[0]).T, (sigma / solved[0]).T
