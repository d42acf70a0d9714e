"""Judges a capture by all quality gates, in the order of the path; `process` and `check` both use it.

A gate that fails means that the result needs a look before use: `process` ends with exit code 3, `check` asks to
reshoot. A gate that warns states an assumption or a loss. Each gate has a finding, a cost in degrees and a remedy. A
difference counts only beyond its measurement error.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from polcap.quality import error_maps, geometry, light, polarization, shot_exposure
from polcap.quality.gate import MOST_DEG, Evidence, Gate, State
from polcap.quality.limits import GateLimits
from polcap.stages.align import AlignSettings

_LARGE_PART = 0.45  # of the expected error: the message names the gates that cost more


def judge(found: Evidence, limits: GateLimits, align: AlignSettings) -> Iterator[Gate]:
    """Judge a capture: yield all quality gates, in the order of the path.

    Raises NotReached: the path ended before a stage that the next gate judges.
    """
    judged: list[Gate] = []
    for gate in _in_order(found, limits, align):
        judged.append(gate)
        yield gate
        if gate.name == "order" and gate.state == "fail":
            return  # with a wrong order nothing after it means anything
    yield _normal_error(found, judged, limits)
    if hasattr(found, "mesh"):
        yield geometry.mesh(found.mesh, limits)


def verdict(gates: Iterable[Gate]) -> State:
    """Verdict of a capture: the worst state of its gates."""
    states = {gate.state for gate in gates}
    return "fail" if "fail" in states else "warn" if "warn" in states else "pass"


def _in_order(found: Evidence, limits: GateLimits, align: AlignSettings) -> Iterator[Gate]:
    yield shot_exposure.exposures(found)
    yield shot_exposure.tone(found, limits)
    yield shot_exposure.source(found)
    yield shot_exposure.black_level(found, limits)
    yield light.chart(found, limits)
    yield geometry.alignment(found, limits, align)
    yield geometry.mask(found, limits)
    yield shot_exposure.stillness(found, limits)
    yield shot_exposure.clipping(found, limits)
    yield geometry.sharpness(found, limits)
    yield geometry.focus(found, limits)
    yield from shot_exposure.gains(found, limits)
    yield polarization.order(found)
    yield from polarization.of_outline(found, limits)
    yield shot_exposure.noise(found, limits)
    yield light.ambient(found, limits)
    yield from light.polarized_light(found, limits)
    yield from light.crossed(found, limits)
    yield polarization.ill_posed(found, limits)
    yield geometry.inward_outline(found, limits)
    yield light.albedo_scale(found, limits)
    yield geometry.focal_length(found)


def _normal_error(found: Evidence, judged: list[Gate], limits: GateLimits) -> Gate:
    """Gate on the median expected error of the normals, with all gates' costs."""
    expected, limit = _median_error(found, judged), limits.max_normal_error_deg
    because = ", ".join(gate.name for gate in judged if gate.cost_deg > _LARGE_PART * expected)
    message = f"Expected error of the normals: {expected:.1f}° (median)"
    if expected == MOST_DEG:
        message = "The normals are unknown"
    message += f", mostly due to: {because}" if because else ""
    if not np.isfinite(expected):
        return Gate("normal error", "not measured", None, limit, message, unit="°")
    if expected <= limit:
        return Gate("normal error", "pass", round(expected, 2), limit, message, unit="°")
    more = "" if len(found.names) > 3 else " four angles,"
    remedy = "See these gates" if because else f"Use more light or frames,{more} or a darker room"
    return Gate("normal error", "fail", round(expected, 2), limit, message, remedy, unit="°")


def _median_error(found: Evidence, judged: list[Gate]) -> float:
    """Median expected normal error [degrees], with all gates' costs."""
    inside = error_maps.expected_normal_error(found, judged)[found.maps.mask]
    return float(np.median(inside)) if inside.size else float("nan")
