"""Judges a capture by all quality gates, causes before consequences; `process` and `check` both use it.

A gate that fails means that the result needs a look before use: `process` ends with exit code 3, `check` asks to
reshoot. A gate that warns states an assumption or a loss. Each gate has a finding, a cost in degrees and a remedy. A
difference counts only beyond its measurement error.

The table `_STEPS` is the picture of causes. A gate that depends on a failed one is "not judged": it has no cost and no
remedy, because its figure shows the same cause again.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from polcap.quality import error_maps, flatness, geometry, light, polarization, shot_exposure, shot_order
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate, State, reaches
from polcap.quality.limits import GateLimits
from polcap.results import (
    FirstResults,
    Results,
    ResultsUntilAlign,
    ResultsUntilHdr,
    ResultsUntilInfer,
    ResultsUntilMask,
    ResultsUntilSelfcal,
    ResultsUntilStokes,
    ResultsUntilWhitebalance,
)

R = TypeVar("R", bound=FirstResults)
_NOISY_PART = 0.3  # of the expected error: with less noise, more light does not help
_SMALL_PX = 3000  # of the object, merged; smaller ones have no room for detail
_LARGE_PART = 0.45  # of the expected error: the message names the gates that cost more

_Judged = Gate | Iterable[Gate]


@dataclass(frozen=True)
class Step(Generic[R]):
    """Gates that one function judges, with their place in the picture of causes."""

    gates: tuple[str, ...]
    judge: Callable[[Evidence[R], GateLimits], _Judged]
    results: type[R]  # without these, there is nothing to judge yet
    after: tuple[str, ...] = ()  # gates whose failure leaves nothing to judge here
    explained_by: tuple[str, ...] = ()  # gates whose warning explains what would be found here, too
    needs: tuple[str, ...] = ()  # gates without whose measurement there is nothing to judge here


def _without_limits(judge: Callable[[Evidence[R]], _Judged]) -> Callable[[Evidence[R], GateLimits], _Judged]:
    """A function for a `Step` from one that takes no limits."""
    return lambda found, _limits: judge(found)


# gates, by what is unknown if one of them fails
_FILES = ("tone curve", "exposures")
_LIT = ("clipping", "ambient", "flicker", "noise")  # no shot is measured
_PAIRED = (*_LIT, "sharpness", "alignment")  # the shots cannot be compared
_EVEN = (*_PAIRED, "stillness", "gains", "energy")  # the light of the shots is not known
_POLARIZED = (*_EVEN, "angles", "polarized", "order")  # the Stokes parameters are wrong
_ONE_LIGHT = (*_POLARIZED, "other light")  # the light is not the flash alone
_SHAPED = (*_POLARIZED, "mask", "body", "other light", "lighting")  # the normals are wrong
_ROUND: dict[str, tuple[str, ...]] = {"explained_by": ("flat",), "needs": ("contour",)}  # for a rounded object

_STEPS = (
    Step(("source",), _without_limits(shot_exposure.source), ResultsUntilHdr),
    Step(("exposures",), _without_limits(shot_exposure.exposures), ResultsUntilHdr),
    Step(("clipping",), shot_exposure.clipping, ResultsUntilHdr),
    Step(("tone curve",), shot_exposure.tone, ResultsUntilSelfcal, ("clipping",)),
    Step(("black level",), shot_exposure.black_level, ResultsUntilHdr, ("clipping",)),
    Step(("ambient",), light.ambient, ResultsUntilHdr),
    Step(("flicker",), light.flicker, ResultsUntilHdr, ("clipping",)),
    Step(("noise",), shot_exposure.noise, ResultsUntilStokes, ("clipping", "ambient", "flicker")),
    Step(("sharpness",), geometry.sharpness, ResultsUntilHdr, _LIT),
    Step(("alignment",), geometry.alignment, ResultsUntilAlign, (*_LIT, "sharpness")),
    Step(("chart",), light.chart, ResultsUntilWhitebalance, ("clipping",)),
    Step(("mask",), geometry.mask, ResultsUntilMask, ("clipping", "alignment")),
    Step(("stillness",), shot_exposure.stillness, ResultsUntilMask, (*_FILES, *_PAIRED), ("black level", "flicker")),
    Step(("focus",), geometry.focus, ResultsUntilMask, _PAIRED),
    Step(("gains", "gain doubt", "energy"), shot_exposure.gains, ResultsUntilSelfcal, (*_PAIRED, "stillness")),
    Step(("angles",), shot_order.turned_shot, ResultsUntilSelfcal, _EVEN),
    Step(("flat", "contour"), _without_limits(flatness.judge), ResultsUntilInfer, _EVEN),
    Step(("polarized",), _without_limits(polarization.polarized), ResultsUntilInfer, _EVEN, ("flat",)),
    Step(("order",), _without_limits(shot_order.order), ResultsUntilSelfcal, (*_EVEN, "polarized")),
    Step(("angles", "body", "other light"), polarization.of_outline, ResultsUntilInfer, _POLARIZED, **_ROUND),
    Step(
        ("room light",),
        light.room_light,
        ResultsUntilInfer,
        (*_ONE_LIGHT, "gain doubt"),
        ("sharpness", "flicker", "gain doubt"),
    ),
    Step(
        ("lighting",), light.side_light, ResultsUntilInfer, _ONE_LIGHT, ("flat", "sharpness", "flicker"), ("contour",)
    ),
    Step(("crossed",), light.crossed, ResultsUntilStokes, _PAIRED),
    Step(
        ("ill-posed",), polarization.ill_posed, ResultsUntilStokes, (*_ONE_LIGHT, "lighting"), ("sharpness", "flicker")
    ),
    Step(("re-rendering",), polarization.explained_by_maps, ResultsUntilInfer, _SHAPED, ("flat",)),
    Step(("outline",), geometry.inward_outline, ResultsUntilInfer, (*_SHAPED, "re-rendering"), **_ROUND),
    Step(("albedo scale",), light.albedo_scale, ResultsUntilInfer, ("clipping", "chart")),
    Step(("focal length",), _without_limits(geometry.focal_length), ResultsUntilInfer),
)


def judge(found: Evidence[FirstResults], limits: GateLimits, failure: Gate | None = None) -> list[Gate]:
    """Judge a capture by all quality gates, in the order of the path.

    `failure` is the gate of the error that ended the path before a stage that gates judge.
    """
    judged: list[Gate] = []
    unreached: list[str] = []
    steps: Iterable[Step[Any]] = _STEPS
    for step in steps:
        if (cause := _cause(step, judged)) is not None:
            known = {gate.name for gate in judged}
            judged += [_not_judged(name, cause) for name in step.gates if name not in known]
        elif reaches(found, step.results):
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
    if not any(gate.name == "order" and gate.state == "fail" for gate in judged) and reaches(found, ResultsUntilInfer):
        judged.append(_normal_error(found, judged, limits))
        if reaches(found, Results):
            judged.append(geometry.mesh(found.results.mesh, limits))
    return judged


def _cause(step: Step[Any], judged: Sequence[Gate]) -> str | None:
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


def _normal_error(found: Evidence[ResultsUntilInfer], judged: list[Gate], limits: GateLimits) -> Gate:
    """Gate on the median expected error of the normals, with all gates' costs."""
    expected, limit = _median_error(found, judged), limits.max_normal_error_deg
    costs = error_maps.unstated_costs(judged)
    because = ", ".join(name for name, cost in costs if cost > _LARGE_PART * expected)
    message = f"Expected error of the normals: {expected:.1f}° (median)"
    if expected == MOST_DEG:
        message = "The normals are unknown"
    message += f", mostly due to: {because}" if because else ""
    if not np.isfinite(expected):
        return Gate("normal error", "not measured", None, limit, message, unit="°")
    if expected <= limit:
        return Gate("normal error", "pass", round(expected, 2), limit, message, unit="°")
    state: State = "fail"
    if any(gate.name == "flat" and gate.state == "warn" for gate in judged):
        state, remedy = "warn", ""
    elif because or any(gate.state == "fail" for gate in judged):  # these gates have the remedy
        remedy = ""
    else:
        state, remedy = _of_object(found, expected)
    return Gate("normal error", state, round(expected, 2), limit, message, remedy, unit="°")


def _of_object(found: Evidence[ResultsUntilInfer], expected: float) -> tuple[State, str]:
    """State and remedy of normals with large errors that no gate explains: noise, or an object that shows little."""
    if _NOISY_PART * expected < shot_exposure.DEGREES_PER_NOISE * shot_exposure.noise_dolp(found.results.stokes):
        return "fail", f"Use more light or frames,{'' if len(found.names) > 3 else ' four angles,'} or a darker room"
    if found.results.object_.mask.sum() * found.grid_px**2 < _SMALL_PX:
        return "warn", "Show the object larger: go nearer, or use a longer lens"
    return "warn", "Tilt the object by 30°: surfaces that face camera and flash are hardly polarized"


def _median_error(found: Evidence[ResultsUntilInfer], judged: list[Gate]) -> float:
    """Median expected normal error [degrees], with all gates' costs."""
    inside = error_maps.expected_normal_error(found, judged)[found.results.maps.mask]
    return float(np.median(inside)) if inside.size else float("nan")
