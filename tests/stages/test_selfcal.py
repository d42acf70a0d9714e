"""Per-shot gains, and the outline's word on the order of the angles."""

import dataclasses

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.images import Equipment
from polcap.optics import mueller, outline
from polcap.stages import selfcal, stokes
from polcap.stages.selfcal import grey_patches, object_gains, order
from polcap.stages.selfcal.ring_zero import RingZero
from tests import scenes

GAIN = np.array([1.0, 1.013, 0.981])


def board_quads() -> np.ndarray:
    """24 squares on the scene's unpolarized board, standing for a chart's patches."""
    quads = []
    for row in range(4):
        for column in range(6):
            x, y = 230 + 11 * column, 36 + 38 * row
            quads.append([[x, y], [x + 9, y], [x + 9, y + 30], [x, y + 30]])
    return np.array(quads, float)


def solve(radiance, color, **settings):
    return selfcal.solve(radiance, scenes.still(), scenes.ball_object(), color, selfcal.Settings(**settings))


def test_grey_patches_give_the_gains_within_their_error():
    color = dataclasses.replace(scenes.no_color(), quads=board_quads(), source="chart")
    found = solve(scenes.stack(gain=GAIN, noise=0.004), color)
    assert found.source == "grey patches"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.002
    z = (found.gain[1:] - GAIN[1:, None]) / found.sigma[1:]
    assert np.abs(z).max() < 4


def test_without_a_chart_the_object_serves():
    found = solve(scenes.stack(gain=GAIN, noise=0.004), scenes.no_color())
    assert found.source == "object"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.005


def test_a_polarized_chart_disagrees_with_the_object():
    radiance = scenes.stack(noise=0.002)
    value = radiance.value.copy()
    value[2, :, 224:300] *= 1.05  # as a chart turned away would
    color = dataclasses.replace(scenes.no_color(), quads=board_quads(), source="chart")
    assert solve(dataclasses.replace(radiance, value=value), color).disagreement > 0.02
    assert solve(radiance, color).disagreement < 1e-4


def test_gloss_on_the_chart_shows_on_its_dark_patches():
    value, variance = np.ones((3, 6)) * (0.9, 0.6, 0.36, 0.2, 0.09, 0.03), np.full((3, 6), 1e-8)
    assert grey_patches._gloss(value * GAIN[:, None], variance) == 0
    value[1] += 0.02  # the same light on dark and light ones, in one shot
    assert grey_patches._gloss(value, variance) == pytest.approx(0.02 / 0.9, rel=0.3)


@pytest.mark.parametrize("angles", [(0, 60, 120), (0, 45, 90, 135), (3, 41, 100, 155, 170)])
def test_orders_that_give_the_same_analyzers_are_one(angles):
    angle = np.radians(np.array(angles, float))
    found = order.hypotheses(angle)
    assert next(iter(found)) == (tuple(range(len(angle))), False)
    analyzers = [mueller.analyzer(turned) for turned in found.values()]
    assert all(np.abs(a - b).max() > 0.02 for i, a in enumerate(analyzers) for b in analyzers[:i])


@pytest.mark.parametrize("angles", [(0, 60, 120), (0, 45, 90, 135), (10, 37, 80, 121, 163)])
def test_any_angles_in_order_are_kept_and_swapped_ones_refused(angles):
    angle = np.radians(np.array(angles, float))
    radiance = scenes.stack(noise=0.002, angles=angle)
    found = selfcal.solve(
        radiance, scenes.still(len(angle)), scenes.ball_object(), scenes.no_color(), selfcal.Settings()
    )
    assert found.order == tuple(range(len(angle))) and not found.mirrored
    swapped = dataclasses.replace(radiance, value=radiance.value[[0, 2, 1, *range(3, len(angle))]])
    with pytest.raises(CaptureError, match="outline"):
        selfcal.solve(swapped, scenes.still(len(angle)), scenes.ball_object(), scenes.no_color(), selfcal.Settings())


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("sectors", [1, 24])
def test_an_outline_that_tells_nothing_supports_no_order(sectors):
    """Unpolarized all round, or seen at one place only: there is no scatter to say how sure it is."""
    sector = np.arange(240) % sectors
    wave = 0.2 * (sectors == 1) * np.cos(2 * np.radians([[0], [60], [120]]))
    unpolarized = outline.Rim(1.0 + wave + np.zeros((3, 240)), np.zeros(240), sector)
    found = order.judge(unpolarized, np.radians([0.0, 60.0, 120.0]), 0.2, 0.25)
    assert found.order == ((0, 1, 2), False)
    assert found.rival == (((0, 1, 2), True) if sectors == 1 else None)  # an axis along x is its own mirror image


def test_one_exposure_has_one_gain():
    radiance = dataclasses.replace(scenes.stack(gain=GAIN), equipment=Equipment("one exposure"))
    found = solve(radiance, scenes.no_color())
    assert found.source == "one exposure"
    assert (found.gain == 1).all() and (found.sigma == 0).all()


def test_gains_that_the_object_is_not_sure_of_are_not_applied():
    far = object_gains.Estimate(np.array([1.0, 0.6, 1.3]), np.array([0.0, 0.2, 0.1]))
    found = selfcal.supported(far, 0.03)
    assert np.abs(found.gain - 1).max() <= 0.03
    wild = object_gains.Estimate(np.array([1.0, 0.6, 1.3]), np.array([0.0, 0.1, 0.08]))
    assert (selfcal.supported(wild, 0.03).gain == 1).all()
    assert selfcal.supported(wild, 0.03).sigma[1] >= 0.4
    misfire = object_gains.Estimate(np.array([1.0, 0.7, 1.0]), np.array([0.0, 0.005, 0.005]))
    assert selfcal.supported(misfire, 0.03).gain[1] == 0.7


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1)])
def test_swapped_shots_are_refused_with_the_order_that_fits(order):
    radiance = scenes.stack(noise=0.002)
    swapped = dataclasses.replace(radiance, value=radiance.value[list(order)])
    names = ", ".join(f"{np.degrees(radiance.angle[i]):g}°" for i in order)
    with pytest.raises(CaptureError, match=f"it supports {names} "):
        solve(swapped, scenes.no_color())


def test_angles_counted_clockwise_are_refused():
    radiance = scenes.stack(noise=0.002, angles=np.radians([0.0, 60.0, 120.0]))
    mirrored = dataclasses.replace(radiance, angle=np.radians([0.0, -60.0, -120.0]))
    with pytest.raises(CaptureError, match="outline"):
        solve(mirrored, scenes.no_color())


def test_an_order_that_fits_as_well_is_named():
    """All angles stated 90° on are those of another order, counted the other way: the outline fits both alike."""
    radiance = scenes.stack(noise=0.002)
    assert solve(radiance, scenes.no_color()).rival == ()
    turned = dataclasses.replace(radiance, angle=radiance.angle + np.pi / 2)
    assert solve(turned, scenes.no_color()).rival


@pytest.mark.parametrize("turn", [7.0, -2.5])
def test_a_ring_whose_zero_is_off_is_found_and_taken_out(turn):
    stated = np.array([0.0, 45.0, 90.0])
    radiance = scenes.stack(noise=0.002, angles=np.radians(stated + turn))
    clocked = dataclasses.replace(radiance, angle=np.radians(stated))
    found = solve(clocked, scenes.no_color())
    assert np.degrees(found.angle_offset) == pytest.approx(turn, abs=3 * np.degrees(found.angle_offset_sigma))
    assert np.degrees(found.angle_offset_sigma) < 0.7
    assert found.angle_correction == found.angle_offset
    right = stokes.solve(radiance, scenes.still(), scenes.equal(), scenes.ball_object(), stokes.Settings())
    mended = stokes.solve(clocked, scenes.still(), found, scenes.ball_object(), stokes.Settings())
    s1, s2 = (right.stokes - mended.stokes)[1:].sum(-1)[:, right.mask]
    polarized = np.hypot(*right.stokes[1:].sum(-1)[:, right.mask])
    assert np.hypot(s1, s2).sum() < 2 * np.radians(1.0) * polarized.sum()


@pytest.mark.parametrize("victim", [1, 2])
def test_one_of_four_angles_that_was_not_what_it_is_called_is_found(victim):
    stated = np.radians([0.0, 45.0, 90.0, 135.0])
    turn = np.radians(15.0) * (np.arange(4) == victim)
    radiance = dataclasses.replace(scenes.stack(noise=0.002, angles=stated + turn), angle=stated)
    found = selfcal.solve(
        radiance, scenes.still(4), scenes.ball_object(), scenes.no_color(), selfcal.Settings(correct_ring=False)
    )
    assert victim in found.turned_shots
    assert abs(np.degrees(found.turned)) == pytest.approx(15, abs=3 * np.degrees(found.turned_sigma) + 1)
    right = scenes.stack(noise=0.002, angles=stated)
    assert (
        selfcal.solve(right, scenes.still(4), scenes.ball_object(), scenes.no_color(), selfcal.Settings()).turned_shots
        == ()
    )


@pytest.mark.parametrize("victim", [1, 2, 3])
def test_of_four_shots_the_one_before_which_the_ring_was_not_turned_is_found(victim):
    stated = np.radians([0.0, 45.0, 90.0, 135.0])
    actual = np.where(np.arange(4) == victim, stated - np.radians(45.0), stated)
    radiance = dataclasses.replace(scenes.stack(noise=0.002, angles=actual), angle=stated)
    settings = selfcal.Settings(check_order=False)
    found = selfcal.solve(radiance, scenes.still(4), scenes.ball_object(), scenes.no_color(), settings)
    assert {victim, victim - 1} & set(found.turned_shots)  # which of two alike it is cannot be seen
    assert abs(np.degrees(found.turned)) > 25


def test_small_errors_of_all_angles_are_no_great_turn_of_the_one_that_closure_tells_least_of():
    stated = np.radians([24.0, 72.0, 90.0, 109.0])
    actual = stated + np.radians([-0.2, -1.0, -1.1, 0.6])  # what a hand sets
    radiance = dataclasses.replace(scenes.stack(noise=0.002, angles=actual), angle=stated)
    settings = selfcal.Settings(correct_ring=False)
    found = selfcal.solve(radiance, scenes.still(4), scenes.ball_object(), scenes.no_color(), settings)
    assert found.turned_shots == ()


def test_of_shots_that_cannot_be_told_apart_the_most_turned_counts():
    """Crossed analyzers stand for one another in the closure, by unlike turns where the other angles lie unevenly."""
    stated = np.radians([81.0, 108.0, 126.0, 171.0])
    radiance = scenes.stack(noise=0.002, angles=stated + np.radians([0, 0, 0, 15.0]))
    unturned = selfcal.Settings(correct_ring=False)
    found = selfcal.solve(
        dataclasses.replace(radiance, angle=stated), scenes.still(4), scenes.ball_object(), scenes.no_color(), unturned
    )
    assert found.turned_shots[0] == 3 and np.degrees(found.turned) == pytest.approx(15, abs=5)


def test_a_calibrated_zero_and_the_outline_are_joined_by_their_errors():
    settings, deg = selfcal.Settings(), np.radians(1.0)
    outline = RingZero(0.6 * deg, 0.4 * deg)
    joined, correction = selfcal.corrected(outline, 0.01 * deg, settings)
    before = np.hypot(0.01, 0.3)  # a thread's play
    share = before**2 / (before**2 + 0.4**2)
    assert correction == joined.turn == pytest.approx(share * 0.6 * deg)
    assert joined.sigma == pytest.approx(before * 0.4 / np.hypot(before, 0.4) * deg)
    vague = RingZero(3 * deg, 2 * deg)
    alone, nothing = selfcal.corrected(vague, 0.01 * deg, settings)
    assert alone.turn == nothing == 0 and alone.sigma == pytest.approx(before * deg)
    another = RingZero(5 * deg, 0.4 * deg)  # the filter was screwed on anew
    assert selfcal.corrected(another, 0.01 * deg, settings) == (another, another.turn)
    assert selfcal.corrected(outline, None, settings) == (outline, 0.0)  # set by eye: within its error


def test_a_ring_set_right_is_left_alone():
    found = solve(scenes.stack(noise=0.002), scenes.no_color())
    assert found.angle_correction == 0
    assert abs(found.angle_offset) < 3 * found.angle_offset_sigma


def test_a_turn_that_the_outline_is_not_sure_of_is_not_applied():
    radiance = scenes.stack(noise=0.002, angles=np.radians([3.0, 48.0, 93.0]))
    clocked = dataclasses.replace(radiance, angle=np.radians([0.0, 45.0, 90.0]))
    assert solve(clocked, scenes.no_color(), correct_ring=False).angle_correction == 0
    etched = dataclasses.replace(clocked, equipment=Equipment("one exposure"))
    assert solve(etched, scenes.no_color()).angle_correction == 0
    cut = dataclasses.replace(scenes.ball_object(), border=0.1)
    found = selfcal.solve(clocked, scenes.still(), cut, scenes.no_color(), selfcal.Settings())
    assert np.degrees(found.angle_correction) == pytest.approx(3.0, abs=0.3)  # the inside tells what the outline cannot


def test_the_check_can_be_left_out():
    radiance = scenes.stack(noise=0.002)
    swapped = dataclasses.replace(radiance, value=radiance.value[[2, 1, 0]])
    assert solve(swapped, scenes.no_color(), check_order=False).order == (2, 1, 0)
