"""In: what the stages made of a capture. Out: every judgement of it, once, for `process` and for `check`.

A gate that fails means: do not trust the result unseen (`process` ends with exit code 3, `check` says reshoot). One
that warns states an assumption, or a loss. Each says what was found, what it costs in degrees and what to do; a
comparison speaks only beyond the error of what it compares.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from polcap.config import Config, Gates
from polcap.images import SurfaceMaps
from polcap.quality import geometry, light, polarization
from polcap.quality.gate import MOST_DEG, Gate, GateEvidence, State, Unit

__all__ = ["Gate", "GateEvidence", "State", "Unit", "judge", "verdict"]


def judge(found: GateEvidence, config: Config) -> Iterator[Gate]:
    """The gates, in the order of the path.

    Raises
    ------
    NotReached
        The path ended before a stage that the next gate judges.
    """
    judged: list[Gate] = []
    for gate in _in_order(found, config):
        judged.append(gate)
        yield gate
        if gate.name == "order" and gate.state == "fail":
            return  # in another order all that follows is another capture's
    yield _normal_error(found, judged, config.gates)
    if hasattr(found, "mesh"):
        yield geometry.mesh(found.mesh, config.gates)


def verdict(gates: Iterable[Gate]) -> State:
    """The worst of the states."""
    states = {gate.state for gate in gates}
    return "fail" if "fail" in states else "warn" if "warn" in states else "pass"


def _in_order(found: GateEvidence, config: Config) -> Iterator[Gate]:
    limits = config.gates
    yield light.bracket(found)
    yield light.tone(found, limits)
    yield light.source(found)
    yield light.stillness(found, limits)
    yield light.chart(found, limits)
    yield geometry.alignment(found, config)
    yield geometry.mask(found, limits)
    yield light.clipping(found, limits)
    yield geometry.sharpness(found, limits)
    yield from light.gains(found, limits)
    yield polarization.order(found)
    yield from polarization.of_outline(found, limits)
    yield light.noise(found, limits)
    yield light.ambient(found, limits)
    yield from light.crossed(found, limits)
    yield polarization.ill_posed(found, limits)
    yield geometry.focal_length(found)


def _normal_error(found: GateEvidence, judged: list[Gate], limits: Gates) -> Gate:
    """The median expected error, with what the other gates add to it."""
    own = _own_error(found.maps)
    expected = min(float(np.sqrt(own**2 + sum(gate.cost_deg**2 for gate in judged))), MOST_DEG)
    because = ", ".join(gate.name for gate in judged if gate.cost_deg > 0.5 * own)
    says = f"expected error of the normals {expected:.1f}° (median)"
    if expected == MOST_DEG:
        says = "nothing is known of the normals"
    says += f", most of it from: {because}" if because else ""
    limit = limits.max_normal_error_deg
    if not np.isfinite(expected):
        return Gate("normal error", "not measured", None, limit, says, unit="°")
    if expected <= limit:
        return Gate("normal error", "pass", round(expected, 2), limit, says, unit="°")
    more = "" if len(found.names) > 3 else " four angles,"
    remedy = "see the lines above" if because else f"more light or frames,{more} or a darker room"
    return Gate("normal error", "fail", round(expected, 2), limit, says, remedy, unit="°")


def _own_error(maps: SurfaceMaps) -> float:
    """Median error that the estimator expects, degrees."""
    inside = maps.confidence[maps.mask]
    return float(np.median(inside)) if inside.size else float("nan")
