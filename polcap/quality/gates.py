"""Judges a capture by all quality gates, causes before consequences; `process` and `check` both use it.

A gate that fails means that the result needs a look before use: `process` ends with exit code 3, `check` asks to
reshoot. A gate that warns states an assumption or a loss. Each gate has a finding, a cost in degrees and a remedy. A
difference counts only beyond its measurement error.

The table `_STEPS` is the picture of causes. A gate that depends on a failed one is "not judged": it has no cost and no
remedy, because its figure shows the same cause again.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from polcap.quality import error_maps, flatness, geometry, light, polarization, rerendering, shot_exposure
from polcap.quality.gate import MOST_DEG, Evidence, Gate, State
from polcap.quality.limits import GateLimits

_LARGE_PART = 0.45  # of the expected error: the message names the gates that cost more

_Judged = Gate | Iterable[Gate]


@dataclass(frozen=True)
class Step:
    """Gates that one function judges, with their place in the picture of causes."""

    gates: tuple[str, ...]
    judge: Callable[[Evidence, GateLimits], _Judged]
    stage: str  # the last stage whose result is judged
    after: tuple[str, ...] = ()  # gates whose failure leaves nothing to judge here
    explained_by: tuple[str, ...] = ()  # gates whose warning explains what would be found here, too
    needs: tuple[str, ...] = ()  # gates without whose measurement there is nothing to judge here


def _without_limits(judge: Callable[[Evidence], _Judged]) -> Callable[[Evidence, GateLimits], _Judged]:
    return lambda found, _limits: judge(found)


_FILES = ("tone curve", "exposures")
_LIT = ("clipping", "noise")  # no shot is measured
_PAIRED = (*_LIT, "sharpness", "alignment")  # the shots cannot be compared
_EVEN = (*_PAIRED, "stillness", "gains", "energy")  # the light of the shots is not known
_POLARIZED = (*_EVEN, "angles", "polarized", "order")  # the Stokes parameters are wrong
_SHAPED = (*_POLARIZED, "mask", "body", "other light", "lighting")  # the normals are wrong
_ROUND: dict[str, tuple[str, ...]] = {"explained_by": ("flat",), "needs": ("contour",)}  # of a rounded object

_STEPS = (
    Step(("source",), _without_limits(shot_exposure.source), "hdr"),
    Step(("exposures",), _without_limits(shot_exposure.exposures), "hdr"),
    Step(("clipping",), shot_exposure.clipping, "hdr"),
    Step(("tone curve",), shot_exposure.tone, "selfcal", ("clipping",)),
    Step(("black level",), shot_exposure.black_level, "hdr", ("clipping",)),
    Step(("noise",), shot_exposure.noise, "stokes", ("clipping",)),
    Step(("sharpness",), geometry.sharpness, "hdr", _LIT),
    Step(("alignment",), geometry.alignment, "align", (*_LIT, "sharpness")),
    Step(("chart",), light.chart, "whitebalance", ("clipping",)),
    Step(("mask",), geometry.mask, "mask", ("clipping", "alignment")),
    Step(("stillness",), shot_exposure.stillness, "mask", (*_FILES, *_PAIRED), ("black level",)),
    Step(("focus",), geometry.focus, "mask", _PAIRED),
    Step(("gains", "gain doubt", "energy"), shot_exposure.gains, "selfcal", (*_PAIRED, "stillness")),
    Step(("angles",), polarization.turned_shot, "selfcal", _EVEN),
    Step(("flat", "contour"), _without_limits(flatness.judge), "infer", _EVEN),
    Step(("polarized",), _without_limits(polarization.polarized), "infer", _EVEN, ("flat",)),
    Step(("order",), _without_limits(polarization.order), "selfcal", (*_EVEN, "polarized"), **_ROUND),
    Step(("angles", "body", "other light"), polarization.of_outline, "infer", _POLARIZED, **_ROUND),
    Step(("ambient",), light.ambient, "hdr"),
    Step(("room light",), light.room_light, "infer", (*_POLARIZED, "other light"), ("sharpness",)),
    Step(("lighting",), light.side_light, "infer", (*_POLARIZED, "other light"), ("flat", "sharpness"), ("contour",)),
    Step(("crossed",), light.crossed, "stokes", _PAIRED),
    Step(("ill-posed",), polarization.ill_posed, "stokes", (*_POLARIZED, "other light", "lighting"), ("sharpness",)),
    Step(("re-rendering",), rerendering.rerendering, "infer", _SHAPED, ("flat",)),
    Step(("outline",), geometry.inward_outline, "infer", (*_SHAPED, "re-rendering"), ("flat",)),
    Step(("albedo scale",), light.albedo_scale, "infer", ("clipping", "chart")),
    Step(("focal length",), _without_limits(geometry.focal_length), "infer"),
)


def judge(found: Evidence, limits: GateLimits, failure: Gate | None = None) -> list[Gate]:
    """Judge a capture by all quality gates, in the order of the path.

    `failure` is the gate of the error that ended the path before a stage that gates judge.
    """
    judged: list[Gate] = []
    unreached: list[str] = []
    for step in _STEPS:
        if (cause := _cause(step, judged)) is not None:
            known = {gate.name for gate in judged}
            judged += [_not_judged(name, cause) for name in step.gates if name not in known]
        elif found.has(step.stage):
            gates = step.judge(found, limits)
            judged += [gates] if isinstance(gates, Gate) else gates
        else:
            unreached += step.gates
    if unreached:
        assert failure is not None  # only an error ends the path before its gates
        cause = next((gate.name for gate in judged if gate.state == "fail"), "")
        if not cause:
            judged, cause = [*(gate for gate in judged if gate.name != failure.name), failure], failure.name
        known = {gate.name for gate in judged}
        judged += [_not_judged(name, cause) for name in dict.fromkeys(unreached) if name not in known]
    if not any(gate.name == "order" and gate.state == "fail" for gate in judged) and found.has("infer"):
        judged.append(_normal_error(found, judged, limits))
        if found.has("surface"):
            judged.append(geometry.mesh(found.mesh, limits))
    return judged


def _cause(step: Step, judged: Sequence[Gate]) -> str | None:
    """Name of the first judged gate that explains what this step would find, if any."""
    for gate in judged:
        if gate.name in {"fail": step.after, "warn": step.explained_by, "not measured": step.needs}.get(gate.state, ()):
            return gate.name
    return None


def _not_judged(name: str, cause: str) -> Gate:
    return Gate(name, "not judged", None, None, f"The gate {cause!r} leaves nothing to judge here", unit="")


def verdict(gates: Iterable[Gate]) -> State:
    """Verdict of a capture: the worst state of its gates."""
    states = {gate.state for gate in gates}
    return "fail" if "fail" in states else "warn" if "warn" in states else "pass"


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
    flat = any(gate.name == "flat" and gate.state == "warn" for gate in judged)
    known = because or flat or any(gate.state == "fail" for gate in judged)  # these gates have the remedy
    remedy = "" if known else f"Use more light or frames,{more} or a darker room"
    return Gate("normal error", "warn" if flat else "fail", round(expected, 2), limit, message, remedy, unit="°")


def _median_error(found: Evidence, judged: list[Gate]) -> float:
    """Median expected normal error [degrees], with all gates' costs."""
    inside = error_maps.expected_normal_error(found, judged)[found.maps.mask]
    return float(np.median(inside)) if inside.size else float("nan")
