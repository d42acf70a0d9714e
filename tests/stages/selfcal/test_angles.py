"""Order, sense and single turns of the angles are checked; angles that nobody noted are found."""

import re
from dataclasses import replace

import numpy as np
import pytest

from polcap.capture_values import ShotOrder
from polcap.errors import CaptureError
from polcap.optics import mueller
from polcap.optics.outline import OutlineBand
from polcap.stage_values import Equipment, OutlineCheck
from polcap.stages import stokes
from polcap.stages.selfcal import angles as angles_
from polcap.stages.selfcal import unknown_angles
from tests import scenes
from tests.stages.selfcal.shapes import misstated, solve

FOUR = np.radians([0.0, 45.0, 90.0, 135.0])


@pytest.mark.parametrize("degrees", [(0, 60, 120), (0, 45, 90, 135), (3, 41, 100, 155, 170)])
def test_orders_that_give_the_same_analyzers_are_one(degrees):
    found = angles_.hypotheses(np.radians(np.array(degrees, float)))
    assert next(iter(found)) == ShotOrder(tuple(range(len(degrees))))
    analyzers = [mueller.analyzer(turned) for turned in found.values()]
    assert all(np.abs(a - b).max() > 0.02 for i, a in enumerate(analyzers) for b in analyzers[:i])


@pytest.mark.parametrize("degrees", [(0, 60, 120), (0, 45, 90, 135), (10, 37, 80, 121, 163)])
def test_angles_in_order_pass_and_swapped_ones_are_refused(degrees):
    radiance = scenes.stack(noise=0.002, angles=np.radians(np.array(degrees, float)))
    assert solve(radiance).outline.as_stated
    with pytest.raises(CaptureError, match="outline"):
        solve(replace(radiance, value=radiance.value[[0, 2, 1, *range(3, len(degrees))]]))


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1)])
def test_swapped_shots_are_refused_with_the_order_that_fits(order):
    radiance = scenes.stack(noise=0.002)
    swapped = replace(radiance, value=radiance.value[list(order)])
    names = ", ".join(f"{np.degrees(radiance.angle[i]):g}°" for i in order)
    with pytest.raises(CaptureError, match=f"; {names} fit better") as caught:
        solve(swapped)
    renamed = re.findall(r"(\d+)° to (\d+)°", str(caught.value))
    assert "rename the folders" in str(caught.value) and "--clockwise" not in str(caught.value)
    assert renamed == [(f"{45 * k}", f"{45 * at}") for k, at in enumerate(order) if k != at]
    assert solve(swapped, check_order=False).outline.best == ShotOrder(order)


def test_angles_counted_clockwise_are_refused():
    radiance = scenes.stack(noise=0.002, angles=np.radians([0.0, 60.0, 120.0]))
    with pytest.raises(CaptureError, match=r"counted clockwise fit better .*: add --clockwise, or clockwise = true"):
        solve(replace(radiance, angle=-radiance.angle))
    assert solve(radiance).outline.as_stated  # as --clockwise corrects it


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("margin", [0.0, 0.2])
@pytest.mark.parametrize("sectors", [1, 24])
def test_an_outline_without_information_supports_no_order(sectors, margin):
    """Unpolarized all round, or visible at one place only: its scatter is unknown."""
    wave = 0.2 * (sectors == 1) * np.cos(2 * np.radians([[0], [60], [120]]))
    rim = OutlineBand(1.0 + wave + np.zeros((3, 240)), np.zeros(240), np.arange(240) % sectors)
    found = angles_.check_order(rim, np.radians([0.0, 60.0, 120.0]), margin, 0.25).check
    assert found.as_stated
    # an axis along x is its own mirror image
    assert found.rival == (ShotOrder((0, 1, 2), mirrored=True) if sectors == 1 else None)


@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_an_order_that_fits_as_well_is_named(margin):
    """All angles stated 90° on are those of another order, counted the other way: the outline fits both alike."""
    for turn, has_rival in ((0.0, False), (np.pi / 2, True)):
        found = solve(misstated(scenes.ANGLES, scenes.ANGLES + turn), order_margin=margin)
        assert (found.outline.rival is not None) == has_rival


@pytest.mark.parametrize(("degrees", "count"), [((0, 45, 90), 11), ((0, 45, 90, 135), 7), ((0, 40, 90, 135), 3)])
def test_orders_that_the_outline_does_not_exclude_explain_the_same_light(degrees, count):
    angle = np.radians(np.array(degrees, float))
    unclear = OutlineCheck(ShotOrder(tuple(range(len(degrees)))), 0.3)
    found = angles_.other_orders(unclear, angle)
    assert len(found) == count
    stokes_ = np.array([1.0, 0.1, -0.05])
    for other in found:
        turned = angle[list(other.order.shots)] * (-1 if other.order.mirrored else 1)
        np.testing.assert_allclose(
            mueller.analyzer(turned) @ other.matrix @ stokes_, mueller.analyzer(angle) @ stokes_, atol=0.02
        )
    assert solve(scenes.stack(noise=0.002)).other_orders == ()


@pytest.mark.parametrize("victim", [1, 2])
def test_one_of_four_angles_that_is_wrong_is_found(victim):
    turned = FOUR + np.radians(15.0) * (np.arange(4) == victim)
    found = solve(misstated(turned, FOUR), correct_ring=False).turned
    assert victim in found.shots
    assert abs(np.degrees(found.angle)) == pytest.approx(15, abs=3 * np.degrees(found.sigma) + 1)
    assert solve(scenes.stack(noise=0.002, angles=FOUR)).turned.shots == ()


@pytest.mark.parametrize("victim", [1, 2, 3])
def test_of_four_shots_the_one_before_which_the_ring_was_not_turned_is_found(victim):
    actual = np.where(np.arange(4) == victim, FOUR - np.radians(45.0), FOUR)
    found = solve(misstated(actual, FOUR), check_order=False).turned
    assert {victim, victim - 1} & set(found.shots)  # both have the same angle: either may be the wrong one
    assert abs(np.degrees(found.angle)) > 25


def test_small_errors_of_all_angles_are_no_great_turn_of_the_least_sensitive_one():
    stated = np.radians([24.0, 72.0, 90.0, 109.0])
    by_hand = stated + np.radians([-0.2, -1.0, -1.1, 0.6])
    assert solve(misstated(by_hand, stated), correct_ring=False).turned.shots == ()


def test_of_shots_that_explain_the_residual_alike_the_most_turned_counts():
    """Crossed analyzers explain the same residual, by different turns where the other angles lie unevenly."""
    stated = np.radians([81.0, 108.0, 126.0, 171.0])
    found = solve(misstated(stated + np.radians([0, 0, 0, 15.0]), stated), correct_ring=False).turned
    assert found.shots[0] == 3 and np.degrees(found.angle) == pytest.approx(15, abs=5)


TRUE = np.radians([12.0, 51.0, 83.0, 118.0, 160.0])
UNNOTED = replace(misstated(TRUE, np.radians(np.arange(5.0)), noise=0.0), equipment=Equipment("one exposure"))


def test_five_angles_of_a_ball_are_found():
    found = solve(UNNOTED, unknown_angles=True)
    error = np.degrees(np.abs((found.angle - TRUE + np.pi / 2) % np.pi - np.pi / 2)).max()
    assert found.found_sigma is not None
    assert error < min(1.5, 3.5 * max(np.degrees(found.found_sigma), 0.3))
    solved, expected = (
        stokes.solve(UNNOTED, scenes.still(5), one, scenes.ball_object(), stokes.StokesSettings())
        for one in (found, replace(found, angle=TRUE))
    )
    off = solved.stokes[1:] - expected.stokes[1:]
    assert np.abs(off[:, solved.mask]).mean() < 0.08 * np.abs(expected.stokes[1:][:, solved.mask]).mean()


@pytest.mark.parametrize(
    "shots, light, most_deg, message",
    [
        (3, "one exposure", 4.0, "3 shots at unknown angles: at least four are needed"),
        (5, "unknown", 4.0, "put a color chart next to the object"),
        (5, "one exposure", 0.01, "error of the polarizer angles found is .*°"),
    ],
)
def test_unknown_angles_that_cannot_be_found_are_refused(shots, light, most_deg, message):
    parts = {name: getattr(UNNOTED, name)[:shots] for name in ("value", "variance", "quality", "angle")}
    radiance = replace(UNNOTED, equipment=Equipment(light), **parts)
    with pytest.raises(CaptureError, match=message):
        solve(radiance, unknown_angles=True, max_unknown_sigma_deg=most_deg)


def test_without_an_outline_angles_stay_unknown():
    rim = OutlineBand(np.zeros((4, 0)), np.zeros(0), np.zeros(0, int))
    assert unknown_angles.find_angles(rim, np.ones((4, 100)), np.zeros(100, int))[1] == np.pi / 2
