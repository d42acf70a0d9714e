"""Gates of the shots' polarizer angles: their order and sense, and single shots that contradict the others."""

from collections.abc import Iterator
from typing import TypeGuard

import numpy as np

from polcap.capture_values import ShotOrder
from polcap.formats.capture import angle_advice
from polcap.quality import flatness
from polcap.quality.gate_values import Evidence, Gate, reaches, sentence, shot_names
from polcap.quality.limits import GateLimits
from polcap.results import ResultsUntilInfer, ResultsUntilSelfcal
from polcap.stage_values import AngleStack, ObjectMask, OrderTest, OutlineCheck

_LIKELIER = 1.1  # factor between expected errors that decides on an order (docs/benchmarks/gates.md)
_LIKELIER_SMALL, _SMALL_PX = 1.5, 5000  # the same for objects of fewer pixels: good captures reach 1.2
_LIKELIER_FLAT = 1.8  # the same for flat objects: good captures reach 1.5, wrong orders 2.2
_LIKELIER_UNEXPLAINED, _ORDER_UNEXPLAINED = 1.3, 0.3  # the same if maps explain less than this: good captures 1.2
_BOX_CONTOUR, _BOX_EXPLAINED = 0.35, 0.6  # three good boxes: factors 1.6, 2.1 and 2.3; .76, .69 and .68 explained
_ORDER_EXPLAINED = 0.4  # part of the polarization from which maps confirm an order: wrong ones up to .26


def order(found: Evidence[ResultsUntilSelfcal]) -> Gate:
    """Gate on the order and sense of the polarizer angles."""
    results, test, shape, explained = found.results, None, None, None
    if reaches(found, ResultsUntilInfer):
        test, explained = found.results.maps.order, found.explained
        shape = flatness.measure(found.results.stokes, found.results.maps)
    return order_of_shots(results.radiance, results.object_, results.selfcal.outline, test, shape, explained)


def order_of_shots(
    radiance: AngleStack,
    object_: ObjectMask,
    outline: OutlineCheck,
    test: OrderTest | None,
    shape: flatness.Flatness | None,
    explained: float | None = None,
) -> Gate:
    """Gate on the order of shots, by the polarization along the outline and the test of the network.

    An outline that is the edge of flat faces decides nothing. Where another order is as good, the stated one counts if
    its maps explain the photographs and the network does not expect smaller errors in another one. The network's test
    sees one small picture, and misjudges boxes and planes; of a bent sheet it knows the normals in no order. If maps
    explain much of their polarization (`explained`, 1 is all), its finding is undecided. If maps explain little, it
    counts; on flat faces it is undecided.
    """
    statement, names, better = radiance.equipment.angles, shot_names(radiance), None
    edges = shape is not None and shape.sharp_edged
    likelier = _likelier(object_, shape, explained)
    if not outline.as_stated and not edges:
        better, because = outline.best, "The outline fits"
    elif test is not None and test.ratio < 1 / likelier and (shape is None or shape.decides(test.ratio)):
        better, because = test.rival, f"The network expects {1 / test.ratio:.1f} times smaller errors for"
    if better is not None and outline.as_stated and _hides_order(shape) and (explained or 0.0) > _BOX_EXPLAINED:
        return _undecided(_order_text(better, names), outline, radiance)
    if better is not None:
        message = f"{because} the order {_order_text(better, names)} rather than the stated one"
        remedy = sentence(angle_advice.correct(statement, better, radiance.angle))
        remedy += "; or take the shots again in order" if statement.place != "cells" else ""
        return Gate("order", "fail", _order_text(better, names), "as stated", message, remedy, 45.0, unit="")
    message = f"The outline supports the stated order (fit {outline.concentration:.2f} of 1)"
    if is_confirmed(test):
        message = f"In any other order, the network expects errors that are at least {test.ratio:.1f} times as large"
    elif edges and test is not None and test.ratio < 1 / _LIKELIER_UNEXPLAINED and _is_unexplained(shape, explained):
        return _undecided(_order_text(test.rival, names), outline, radiance)
    elif edges:
        return Gate("order", "not measured", None, "as stated", "Flat faces show no order of the angles", unit="")
    elif outline.rival is not None and (explained or 0.0) > _ORDER_EXPLAINED and (test is None or test.ratio >= 1):
        message = "The maps of the stated order, rendered again, show the polarization of the photographs"
    elif outline.rival is not None:
        return _undecided(_order_text(outline.rival, names), outline, radiance)
    return Gate("order", "pass", "as stated", "as stated", message, unit="")


def _likelier(object_: ObjectMask, shape: flatness.Flatness | None, explained: float | None) -> float:
    """Factor between expected errors that decides on an order: larger where good captures reach more."""
    if shape is not None and shape.flat:
        return _LIKELIER_FLAT
    likelier = _LIKELIER if object_.mask.sum() > _SMALL_PX else _LIKELIER_SMALL
    return min(likelier, _LIKELIER_UNEXPLAINED) if _is_unexplained(shape, explained) else likelier


def _is_unexplained(shape: flatness.Flatness | None, explained: float | None) -> bool:
    """Whether maps explain little of the polarization; a facing plane has little to explain."""
    faces = shape is not None and shape.unpolarized
    return explained is not None and explained < _ORDER_UNEXPLAINED and not faces


def _hides_order(shape: flatness.Flatness | None) -> bool:
    """Whether an object is flat, or has hardly any occluding contour."""
    return shape is not None and (shape.flat or shape.contour < _BOX_CONTOUR)


def _undecided(other: str, outline: OutlineCheck, radiance: AngleStack) -> Gate:
    """Gate on an order of the shots that another one matches."""
    message = f"The order {other} fits as well as the stated one (fit of the outline {outline.concentration:.2f} of 1)"
    decisive = "a rounded object or a chart" + ("" if len(radiance.angle) > 3 else " or four angles")
    remedy = sentence(f"{angle_advice.check_statement(radiance.equipment.angles)}; {decisive} would decide")
    return Gate("order", "warn", "cannot tell", "as stated", message, remedy, unit="")


def is_confirmed(test: OrderTest | None) -> TypeGuard[OrderTest]:
    """Whether the network expects clearly larger errors in any other order: the object is polarized as it should be."""
    return test is not None and test.ratio > _LIKELIER


def _order_text(order: ShotOrder, names: list[str]) -> str:
    return ", ".join(names[i] for i in order.shots) + (", counted clockwise" if order.mirrored else "")


def turned_shot(found: Evidence[ResultsUntilSelfcal], limits: GateLimits) -> Iterator[Gate]:
    """Gate "angles", only if the polarizer angle of one shot contradicts those of three or more other shots."""
    turned, limit = found.results.selfcal.turned, limits.max_turn_deg
    if not turned.shots or abs(np.degrees(turned.angle)) <= limit:
        return
    degrees, doubt = np.degrees([turned.angle, turned.sigma])
    shots = tuple(found.names[k] for k in turned.shots)
    which = shots[0] if len(shots) == 1 else f"{shots[0]} (or {', '.join(shots[1:])}, by as much or less)"
    message = f"{which} looks turned by {degrees:+.0f}° ± {doubt:.0f}°: the shots contradict each other"
    remedy = sentence(angle_advice.retake(found.results.radiance.equipment.angles))
    yield Gate("angles", "fail", round(float(degrees), 1), limit, message, remedy, abs(float(degrees)) / 2, shots, "°")
