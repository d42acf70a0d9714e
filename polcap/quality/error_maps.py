"""Expected errors of each pixel: those of the estimator, and the costs of all gates.

A finding of a gate costs the same on the whole object, unless it has a place in `_PLACES`: there its pixels have their
own costs, also where they are too few for a finding.
"""

from collections.abc import Callable, Iterable, Mapping

import cv2
import numpy as np

from polcap.images import Bools, Floats, Quality
from polcap.optics.outline import disc_radius
from polcap.optics.resize import area_mean
from polcap.quality import geometry
from polcap.quality.gate import MOST_DEG, Evidence, Gate

_AROUND = 0.12  # 1σ over the object's radius: how far clipped pixels mislead the estimator
_FINEST_PX = 4.0  # this distance on the reduced grid on which it is computed
# degrees by the share of clipped pixels around, most at the edge of a clipped part (docs/benchmarks/gates.md)
_CLIPPED_AROUND = (0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0)
_CLIPPED_DEG = (0.0, 5.0, 9.5, 22.0, 28.0, 25.0, 18.0)
_CLIPPED_PART = 0.3  # clipped part of the object with these costs; they grow with its root, as a highlight's width
_GHOST_DEG = 5.0  # where the exposures of a shot differ


def expected_normal_error(found: Evidence, judged: Iterable[Gate]) -> Floats:
    """Expected error of the normals (H, W), degrees: root of the squares of the estimator's own and all costs."""
    places = {name: cost(found) for name, cost in _PLACES.items()}
    everywhere = sum(gate.cost_deg**2 for gate in judged if gate.name not in places)
    squares = found.maps.confidence**2 + everywhere + sum(cost**2 for cost in places.values())
    return np.where(found.maps.mask, np.minimum(np.sqrt(squares), MOST_DEG), 0).astype(np.float32)


def _of_clipping(found: Evidence) -> Floats:
    """Cost (H, W) of clipped light, in degrees: normals look flat there, and bend towards it around."""
    clipped, mask = _flagged(found, Quality.CLIPPED), found.maps.mask
    if not clipped.any():
        return np.zeros(1)
    width = np.sqrt(clipped.sum() / mask.sum() / _CLIPPED_PART)
    return np.asarray(width * np.interp(_share_around(clipped, mask), _CLIPPED_AROUND, _CLIPPED_DEG))


def _of_ghosts(found: Evidence) -> Floats:
    """Cost (H, W) of pixels that differ between the exposures of a shot, in degrees."""
    return _GHOST_DEG * _flagged(found, Quality.GHOST)


def _of_ill_posed(found: Evidence) -> Floats:
    """No cost: the estimators state the error of these pixels themselves."""
    return np.zeros(1)


def _of_focal_length(found: Evidence) -> Floats:
    """Cost (H, W) of an unknown focal length, in degrees: by how much it tilts the view ray."""
    if not any(found.focal_doubt):
        return np.zeros(1)
    return geometry.lean(found.maps, *found.focal_doubt)


def _flagged(found: Evidence, bit: Quality) -> Bools:
    return found.maps.mask & ((found.stokes.quality & np.uint8(bit)) > 0)


def _share_around(chosen: Bools, inside: Bools) -> Floats:
    """Share (H, W) of the pixels `inside` around each pixel that are `chosen`, by a Gaussian."""
    sigma = max(_AROUND * disc_radius(inside), 1e-3)
    shrink = min(1.0, _FINEST_PX / sigma)
    shape = tuple(max(1, round(side * shrink)) for side in inside.shape)
    part, whole = (cv2.GaussianBlur(area_mean(one, shape), (0, 0), sigma * shrink) for one in (chosen, inside))
    return np.asarray(cv2.resize(part / np.maximum(whole, 1e-6), inside.shape[::-1]))


_PLACES: Mapping[str, Callable[[Evidence], Floats]] = {
    "clipping": _of_clipping,
    "stillness": _of_ghosts,
    "ill-posed": _of_ill_posed,
    "focal length": _of_focal_length,
}
