"""Whether the object moved against what is around it, which one transform for the whole picture hides.

A zoom and a roll of the camera, as a similarity allows them, can stand for an object that was pushed while chart and
backdrop stood still. So both are laid over the reference shot on their own, and meet at the object's middle.
"""

import cv2
import numpy as np

from polcap.images import Alignment, AngleStack, Floats, ObjectMask
from polcap.stages.align.following import Detail, Scale, fine, likeness, refine, sigma_at, to_full_grid

_DETAIL_PX = 4.0  # as `align.detail_px`
_MOST_PIXELS = 0.8e6  # a larger picture is averaged down first
_BEYOND_PX = 6  # around the object, where its outline still tells
_SURE_LIKENESS = 0.6  # of detail, from which a region is known to have been followed
_OTHER_LIKENESS = 0.4  # of the object, below which it is another, or too far away
_SURE_SIGMAS = 3.0  # of both places: a chart in a corner tells little of where the object's middle should be
_ALIKE_PX = 0.5  # two ways that differ by less lead to one place
_ANY_LIKENESS = 0.4  # where nothing moved; noise and an even backdrop have less


def measure(radiance: AngleStack, alignment: Alignment, object_: ObjectMask) -> Floats:
    """How far the object moved against its surroundings, (K,) px of the grid; 0 within three errors of both places.

    NaN where either has no detail to be followed, infinite where the surroundings are the same and the object is not.
    """
    shots = len(radiance.angle)
    displacement = np.full(shots, np.nan)
    displacement[0] = 0.0
    if radiance.offset_px is not None:  # shots cut from one mosaic
        return np.zeros(shots)
    if not object_.mask.any():
        return displacement
    step = int(np.ceil(np.sqrt(object_.mask.size / _MOST_PIXELS)))
    reference = fine(radiance.shot(0), _DETAIL_PX, step)
    height, width = reference.value.shape
    reach = 2 * _BEYOND_PX + 1
    small = cv2.resize(object_.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA)
    near = cv2.dilate(small, np.ones((reach, reach), np.uint8)).astype(np.float32)
    regions = [Detail(Scale(reference.value, reference.weight * part)) for part in (near, 1 - near)]
    y, x = np.nonzero(small)
    middle = np.array([x.mean(), y.mean(), 1.0]) if len(x) else np.array([width / 2, height / 2, 1.0])
    for k in range(1, shots):
        shot = Detail(fine(radiance.shot(k), _DETAIL_PX, step))
        known = to_full_grid(alignment.transform[k], 1 / step)
        found = [_followed(region, shot, known) for region in regions]
        here, around = (like for _, like in found)
        if around > _SURE_LIKENESS and here < _OTHER_LIKENESS:
            displacement[k] = np.inf
        elif min(here, around) > _SURE_LIKENESS:
            at = [(transform @ middle)[:2] / (transform @ middle)[2] for transform, _ in found]
            inner, outer = (sigma_at(region, shot, way, middle) for region, (way, _) in zip(regions, found))
            doubt = float(np.hypot(inner, outer))
            seems = float(np.hypot(*(at[0] - at[1])))
            displacement[k] = step * seems if seems > _SURE_SIGMAS * doubt else 0.0
    return displacement


def _followed(region: Detail, shot: Detail, known: Floats) -> tuple[Floats, float]:
    """Where a region lies in a shot, begun from where the whole picture does, and from where nothing moved."""
    height, width = region[1].value.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    moved = known @ corners
    still = np.abs(moved[:2] / moved[2] - corners[:2]).max() < _ALIKE_PX
    starts = [(way, likeness(region, shot, way)) for way in ((known,) if still else (known, np.eye(3)))]
    if max(starts, key=_like)[1] < _ANY_LIKENESS:
        return max(starts, key=_like)
    ways = [refine(region, shot, start, "similarity")[0] for start, _ in starts]
    return max(((way, likeness(region, shot, way)) for way in ways), key=_like)


def _like(found: tuple[Floats, float]) -> float:
    return found[1]
