"""Expected errors grow where the gates' findings are, and only there."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from polcap.config import Config
from polcap.image_values import Floats, Quality
from polcap.optics.morphology import dilate
from polcap.optics.outline import disc_radius
from polcap.quality import error_maps, gates
from polcap.quality.gate_values import Gate
from tests.quality.test_gates import Seen, changed, found

OWN = 4.0  # degrees, expected error of the estimator


@pytest.fixture(scope="module")
def good() -> Seen:
    return found()


def flagged(good: Seen, bit: Quality, width: int) -> tuple[Seen, Any]:
    """The capture with a flagged square of this width in the middle of the object, and the square (H, W)."""
    mask = good.results.maps.mask
    row, column = (int(np.median(at)) for at in np.nonzero(mask))
    square = np.zeros(mask.shape, bool)
    square[row - width // 2 : row + width // 2, column - width // 2 : column + width // 2] = True
    quality = good.results.stokes.quality | np.where(square, np.uint8(bit), np.uint8(0))
    return changed(good, stokes=replace(good.results.stokes, quality=quality)), square


def errors(of: Seen, *judged: Gate) -> Floats:
    return error_maps.expected_normal_error(of, judged)


def test_without_findings_the_error_is_the_estimators_own(good: Seen) -> None:
    error = errors(good)
    assert np.allclose(error[good.results.maps.mask], OWN) and not error[~good.results.maps.mask].any()


def test_a_cost_without_a_place_counts_on_the_whole_object_and_costs_add_in_squares(good: Seen) -> None:
    error = errors(good, *(Gate(name, "warn", None, None, "", cost_deg=6.0) for name in ("gains", "source")))
    assert np.allclose(error[good.results.maps.mask], np.sqrt(OWN**2 + 2 * 6**2))


def test_what_the_estimators_state_themselves_is_not_added_in_full(good: Seen) -> None:
    gates_ = [Gate(name, "fail", None, None, "", cost_deg=10.0) for name in ("sharpness", "ill-posed")]
    blurred, ill_posed = (errors(good, gate)[good.results.maps.mask] for gate in gates_)
    assert np.allclose(blurred, np.hypot(OWN, 7)) and np.allclose(ill_posed, OWN)


def test_a_failed_rerendering_replaces_the_error_that_the_estimator_states(good: Seen) -> None:
    gate = Gate("re-rendering", "fail", None, None, "", cost_deg=30.0)
    maps = good.results.maps
    unsure = changed(good, maps=replace(maps, confidence=np.where(maps.mask, np.float32(35), np.float32(0))))
    assert np.allclose(errors(good, gate)[maps.mask], 30) and np.allclose(errors(unsure, gate)[maps.mask], 35)


@pytest.mark.parametrize(("agreement", "cost"), [(0.22, 9.0), (0.6, 0.0)])  # wax; sharp edges as outline
def test_a_finding_at_the_outline_costs_nothing_if_the_maps_show_the_photographs(
    good: Seen, agreement: float, cost: float
) -> None:
    body = Gate("body", "warn", None, None, "", cost_deg=9.0)
    shown = Gate("re-rendering", "pass", agreement, None, "")
    assert np.allclose(errors(good, body, shown)[good.results.maps.mask], np.hypot(OWN, cost))
    assert np.allclose(errors(good, body)[good.results.maps.mask], np.hypot(OWN, 9))


def test_clipped_light_costs_in_its_place_alone_and_once(good: Seen) -> None:
    mask = good.results.maps.mask
    of, square = flagged(good, Quality.CLIPPED, round(0.6 * disc_radius(mask)))
    gate = Gate("clipping", "fail", 0.3, 0.02, "", cost_deg=20.0)
    error = errors(of, gate)
    assert np.array_equal(error, errors(of))  # not of the gate again
    away = mask & ~dilate(square, round(0.4 * disc_radius(mask)))
    assert error[square].min() > OWN + 2 and np.allclose(error[away], OWN, atol=0.3)


def test_a_small_clipped_highlight_costs_less_than_a_wide_one(good: Seen) -> None:
    radius = disc_radius(good.results.maps.mask)
    squares = (flagged(good, Quality.CLIPPED, round(share * radius)) for share in (0.05, 0.2, 0.8))
    cost = [errors(of)[square].max() for of, square in squares]
    assert OWN <= cost[0] < OWN + 0.5 < cost[1] < cost[2]


def test_exposures_that_differ_cost_in_these_pixels(good: Seen) -> None:
    of, square = flagged(good, Quality.GHOST, 10)
    error = errors(of, Gate("stillness", "fail", 0.1, 0.02, "", cost_deg=5.0))
    assert np.allclose(error[square], np.hypot(OWN, 5)) and np.allclose(error[good.results.maps.mask & ~square], OWN)


def test_an_assumed_focal_length_costs_more_away_from_the_middle_of_the_picture(good: Seen) -> None:
    view, mask = good.results.maps.view, good.results.maps.mask
    error = errors(changed(good, focal_doubt=(-0.7, 0.7)), Gate("focal length", "warn", None, None, "", cost_deg=9.0))
    y, x = np.nonzero(mask)
    off = np.hypot(x - view.center[0], y - view.center[1])
    order = np.argsort(off)
    assert np.all(np.diff(error[mask][order]) > -1e-3)
    assert error[mask][order[-1]] > error[mask][order[0]]


def test_the_headline_is_the_median_of_the_map(good: Seen) -> None:
    of, _ = flagged(good, Quality.CLIPPED, round(1.2 * disc_radius(good.results.maps.mask)))
    judged = gates.judge(of, Config().gates)
    (headline,) = (gate.value for gate in judged if gate.name == "normal error")
    error = error_maps.expected_normal_error(of, judged)
    median = float(np.median(error[of.results.maps.mask]))
    assert headline == pytest.approx(median, abs=0.006) and median > OWN


def material_errors(of: Seen) -> tuple[Floats, Floats]:
    maps = error_maps.with_errors(of, ())
    assert maps.diffuse_error is not None and maps.roughness_error is not None
    return maps.diffuse_error, maps.roughness_error


def test_albedo_and_roughness_have_errors_on_the_object_only(good: Seen) -> None:
    mask = good.results.maps.mask
    for error in material_errors(good):
        assert error[mask].min() > 0 and error.max() < 1 and not error[~mask].any()


def test_the_error_of_the_albedo_follows_its_brightness_and_the_error_of_the_normals(good: Seen) -> None:
    maps = good.results.maps
    dark = changed(good, maps=replace(maps, diffuse=maps.diffuse / 4))
    sure = changed(good, maps=replace(maps, confidence=maps.confidence / 4))
    usual, of_dark, of_sure = (material_errors(of)[0][maps.mask].mean() for of in (good, dark, sure))
    assert of_dark == pytest.approx(usual / 2, rel=0.05) and of_sure == pytest.approx(usual / 2, rel=0.05)


def test_clipped_light_makes_albedo_uncertain_there(good: Seen) -> None:
    mask = good.results.maps.mask
    of, square = flagged(good, Quality.CLIPPED, round(0.6 * disc_radius(mask)))
    away = mask & ~dilate(square, round(0.4 * disc_radius(mask)))
    albedo, usual = material_errors(of)[0], material_errors(good)[0]
    assert (albedo[square] > 1.05 * usual[square]).all()
    assert np.allclose(albedo[away], usual[away], rtol=0.02)


def test_the_network_states_the_error_of_its_roughness_and_that_of_the_inversion_is_larger(good: Seen) -> None:
    maps = good.results.maps
    stated = np.where(maps.mask, np.float32(0.07), np.float32(0))
    network = changed(good, maps=replace(maps, estimator="network", roughness_error=stated))
    (albedo, rough), (of_network, same) = material_errors(good), material_errors(network)
    assert np.array_equal(same, stated)
    assert (albedo[maps.mask] > of_network[maps.mask]).all() and (rough[maps.mask] > stated[maps.mask]).all()
