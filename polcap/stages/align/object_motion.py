"""Detects motion of the object relative to its surroundings, which one transform of the whole picture would hide.

If the object moved while chart and backdrop stayed, one transform fits both by a false zoom and roll. So object
and surroundings are registered separately, and the two motions are compared in the middle of the object.
"""

from dataclasses import dataclass

import numpy as np

from polcap.image_values import Floats
from polcap.optics import registration
from polcap.optics.morphology import dilate
from polcap.optics.projection import picture_corners, transform_points
from polcap.optics.registration import Pyramid, Registration
from polcap.optics.resize import area_mean, block_step
from polcap.stage_values import Alignment, AngleStack, ObjectMask
from polcap.stages.align.detail import detail

_DETAIL_PX = 4.0  # as `align.detail_px`
_MOST_PIXELS = 0.8e6  # a larger picture is averaged down first
_RIM_PX = 6  # width of backdrop around the object's region, so that the region includes the outline
_FOUND_CORRELATION = 0.6  # of detail; a region with more was found in the shot
_OTHER_CORRELATION = 0.4  # of the object; with less it is another object, or too far away. Noise has less
_ERROR_SCALE = 1.1  # actual error of the shift over that of the tiles, in 152 still shots (docs/benchmarks/gates.md)
_PARAMETERS = 4  # of a similarity; each tile gives two measurements
_SAME_PX = 0.5  # two starts of a registration that differ by less give the same result


@dataclass(frozen=True)
class ObjectShift:
    """Shift of the object's middle, outline included, relative to chart and backdrop in each shot.

    Infinite: the shot shows another object; NaN: too little detail. The error is large if a chart in a corner is all of
    the surroundings, because its registration is uncertain at the object's middle.
    """

    length: Floats  # (K,) merged px
    sigma: Floats  # (K,) rms length of its error [merged px]


def measure(radiance: AngleStack, alignment: Alignment, object_: ObjectMask) -> ObjectShift:
    """Register object and surroundings of each shot separately, and compare the two motions."""
    shots = len(radiance.angle)
    shift = ObjectShift(*np.zeros((2, shots)))
    if radiance.offset_px is not None:  # shots cut from one mosaic: nothing moves between them
        return shift
    shift.length[1:] = np.nan  # until measured
    if not object_.mask.any():
        return shift
    step = block_step(object_.mask.size, _MOST_PIXELS)
    reference = detail(radiance.shot(0), _DETAIL_PX, step)[0]
    small = area_mean(object_.mask.astype(np.uint8), reference.picture.shape)
    around = dilate(small > 0, _RIM_PX)
    regions = [Pyramid(reference.picture, reference.usable & region) for region in (around, ~around)]
    middle = np.argwhere(small).mean(axis=0)[::-1] if small.any() else np.array(small.shape[::-1]) / 2
    for k in range(1, shots):
        shot = detail(radiance.shot(k), _DETAIL_PX, step)
        start = registration.scaled(alignment.transform[k], 1 / step)
        (inner, inner_match), (outer, outer_match) = (_register(region, shot, start) for region in regions)
        if outer_match > _FOUND_CORRELATION and inner_match < _OTHER_CORRELATION:
            shift.length[k] = np.inf  # another object
        elif min(inner_match, outer_match) > _FOUND_CORRELATION:
            positions = [transform_points(found.matrix, middle) for found in (inner, outer)]
            per_axis = np.hypot(inner.sigma_at(middle), outer.sigma_at(middle))
            shift.length[k] = step * np.hypot(*(positions[0] - positions[1]))
            shift.sigma[k] = step * _ERROR_SCALE * np.sqrt(2) * per_axis * _student(min(inner.tiles, outer.tiles))
    return shift


def _student(tiles: int) -> float:
    """Factor on a 1σ from few tiles after which errors above 3σ are as rare as in a normal law, by Student's t."""
    from scipy.special import ndtr, stdtrit  # here: the import takes 0.2 s

    return float(stdtrit(max(2 * tiles - _PARAMETERS, 1), ndtr(3.0)) / 3)


def _register(region: Pyramid, shot: Pyramid, start: Floats) -> tuple[Registration, float]:
    """Register one region of the picture: its motion and the correlation.

    The search starts from no motion and from the motion `start` (3, 3) of the whole picture. The better result counts.
    """
    found = [registration.register(region, shot, "similarity")]
    corners = picture_corners(region.shape[1], region.shape[0])
    if np.abs(transform_points(start, corners) - corners).max() > _SAME_PX:
        found.append(registration.refine(region, shot, "similarity", start))
    return max(((one, registration.correlation(region, shot, one.matrix)) for one in found), key=lambda pair: pair[1])
