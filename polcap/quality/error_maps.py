"""Expected errors of each pixel: of the normals, of the albedo and of the roughness.

The error of the roughness is the estimator's own. To the error of a normal the costs of all gates are added. A finding
of a gate costs the same on the whole object. Gates in `_PLACES` have a cost for each pixel instead, also if too few
pixels have one for a finding.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import cv2
import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.optics.outline import disc_radius
from polcap.optics.resize import area_mean
from polcap.quality import geometry
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate
from polcap.results import ResultsUntilInfer
from polcap.stage_values import SurfaceMaps

_AROUND = 0.12  # 1σ over the object's radius: how far clipped pixels mislead the estimator
_FINEST_PX = 4.0  # the same distance, in pixels of the reduced grid of the computation
# degrees by the share of clipped pixels around, most at the edge of a clipped part (docs/benchmarks/gates.md)
_CLIPPED_AROUND = (0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0)
_CLIPPED_DEG = (0.0, 5.0, 9.5, 22.0, 28.0, 25.0, 18.0)
_CLIPPED_PART = 0.3  # clipped part of the object with these costs; they grow with its root, as a highlight's width
# part of a cost that is not in the estimators' own error: they expect larger errors where polarization is contradictory
_UNSTATED = {"sharpness": 0.7, "ill-posed": 0.0}
# agreement of the re-rendering from which `body` is a false finding (docs/benchmarks/gates.md); of wax it is .22
_CONFIRMED = 0.45
_RERENDERING = "re-rendering"  # its cost is the whole error, if the estimators state less
_GHOST_DEG = 5.0  # where the exposures of a shot differ
# 1σ by 150 simulated captures and the 4 rendered ones (docs/benchmarks/albedo.md); (network, analytic)
_ALBEDO = (0.04, 0.06)  # of the diffuse albedo, times the root of albedo times expected normal error [degrees]
_DARKEST = 0.01  # albedo
_ALBEDO_MOST_DEG = 20.0  # normal error: a larger one does not change the albedo more
_ALBEDO_CLIPPED = 3.0  # relative, times the clipped shares of the object and around: light that no shot shows
_ROUGHNESS_OF_INVERSION = 0.17  # the inversion assumes one roughness


def with_errors(found: Evidence[ResultsUntilInfer], judged: Iterable[Gate]) -> SurfaceMaps:
    """The maps with the expected errors of normals, albedo and roughness, with the costs of all gates."""
    return replace(
        found.results.maps,
        confidence=expected_normal_error(found, judged),
        diffuse_error=_diffuse_error(found),
        roughness_error=_roughness_error(found.results.maps),
    )


def expected_normal_error(found: Evidence[ResultsUntilInfer], judged: Iterable[Gate]) -> Floats:
    """Expected error of the normals (H, W), degrees: root of the squares of the estimator's own and all costs."""
    places = {name: cost(found) for name, cost in _PLACES.items()}
    costs = [(name, cost) for name, cost in unstated_costs(judged) if name not in places]
    everywhere = sum(cost**2 for name, cost in costs if name != _RERENDERING)
    own = np.maximum(found.results.maps.confidence, sum(cost for name, cost in costs if name == _RERENDERING))
    squares = own**2 + everywhere + sum(cost**2 for cost in places.values())
    return np.where(found.results.maps.mask, np.minimum(np.sqrt(squares), MOST_DEG), 0).astype(np.float32)


def unstated_costs(judged: Iterable[Gate]) -> list[tuple[str, float]]:
    """Names of the gates with their costs [degrees], as far as the estimators do not state these themselves."""
    gates = list(judged)
    agreement = (gate.value for gate in gates if gate.name == _RERENDERING and gate.state == "pass")
    confirmed = any(isinstance(value, float) and value > _CONFIRMED for value in agreement)
    parts = _UNSTATED | ({"body": 0.0} if confirmed else {})
    return [(gate.name, parts.get(gate.name, 1.0) * gate.cost_deg) for gate in gates]


def _of_clipping(found: Evidence[ResultsUntilInfer]) -> Floats:
    """Cost (H, W) of clipped light, in degrees: normals look flat there, and bend towards it around."""
    clipped, mask = _flagged(found, Quality.CLIPPED), found.results.maps.mask
    if not clipped.any():
        return np.zeros(1)
    width = np.sqrt(clipped.sum() / mask.sum() / _CLIPPED_PART)
    return np.asarray(width * np.interp(_share_around(clipped, mask), _CLIPPED_AROUND, _CLIPPED_DEG))


def _of_ghosts(found: Evidence[ResultsUntilInfer]) -> Floats:
    """Cost (H, W) of pixels that differ between the exposures of a shot, in degrees."""
    return _GHOST_DEG * _flagged(found, Quality.GHOST)


def _of_focal_length(found: Evidence[ResultsUntilInfer]) -> Floats:
    """Cost (H, W) of an unknown focal length, in degrees: the tilt of the view ray."""
    if not any(found.focal_doubt):
        return np.zeros(1)
    return geometry.ray_doubt_deg(found.results.maps, *found.focal_doubt)


def _diffuse_error(found: Evidence[ResultsUntilInfer]) -> Floats:
    """1σ of the diffuse albedo (H, W), mean of the channels, if chart and object had the same light."""
    maps, clipped = found.results.maps, _flagged(found, Quality.CLIPPED)
    albedo = np.maximum(maps.diffuse.mean(axis=-1), _DARKEST)
    error = _ALBEDO[maps.estimator == "analytic"] * np.sqrt(albedo * np.minimum(maps.confidence, _ALBEDO_MOST_DEG))
    if clipped.any():
        hidden = _ALBEDO_CLIPPED * clipped.sum() / maps.mask.sum()
        error = np.hypot(error, hidden * _share_around(clipped, maps.mask) * albedo)
    return np.where(maps.mask, np.minimum(error, 1), 0).astype(np.float32)


def _roughness_error(maps: SurfaceMaps) -> Floats:
    """1σ of the roughness (H, W): that of the network's materials, or of the inversion."""
    error = _ROUGHNESS_OF_INVERSION if maps.roughness_error is None else maps.roughness_error
    return np.where(maps.mask, error, 0).astype(np.float32)


def _flagged(found: Evidence[ResultsUntilInfer], bit: Quality) -> Bools:
    return found.results.maps.mask & ((found.results.stokes.quality & np.uint8(bit)) > 0)


def _share_around(chosen: Bools, inside: Bools) -> Floats:
    """Share (H, W) of the pixels `inside` around each pixel that are `chosen`, by a Gaussian."""
    sigma = max(_AROUND * disc_radius(inside), 1e-3)
    shrink = min(1.0, _FINEST_PX / sigma)
    shape = tuple(max(1, round(side * shrink)) for side in inside.shape)
    part, total = (cv2.GaussianBlur(area_mean(one, shape), (0, 0), sigma * shrink) for one in (chosen, inside))
    return np.asarray(cv2.resize(part / np.maximum(total, 1e-6), inside.shape[::-1]))


_PLACES: Mapping[str, Callable[[Evidence[ResultsUntilInfer]], Floats]] = {  # (H, W), or (1,) of zero, degrees
    "clipping": _of_clipping,
    "stillness": _of_ghosts,
    "focal length": _of_focal_length,
}
