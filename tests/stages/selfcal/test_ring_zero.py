"""The ring's zero by outline and slopes is within its error, and corrected where it is certain."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.stage_values import Equipment, RingZero
from polcap.stages import selfcal, stokes
from polcap.stages.selfcal import ring_zero
from tests import scenes
from tests.stages.selfcal.shapes import ANGLES, SHAPES, inside, misstated, shots, solve

DEG = np.radians(1.0)


def by_slopes(light: Floats, gain_sigma: float = 0.001, angle: Floats = ANGLES) -> RingZero:
    return ring_zero.by_slopes(light, inside(light), angle, gain_sigma)


def within(found: RingZero, true: float) -> bool:
    return abs(found.offset - true) < 3 * found.sigma


@pytest.mark.parametrize("shape", SHAPES)
def test_the_turn_is_the_one_that_makes_slopes_a_heights(shape: str, rng: np.random.Generator) -> None:
    found = by_slopes(shots(SHAPES[shape], rng, ANGLES + 4 * DEG, np.array([1.0, 1.001, 0.999])))
    assert within(found, 4 * DEG) and found.sigma < 0.6 * DEG


def test_unknown_gains_are_found_with_the_turn(rng: np.random.Generator) -> None:
    light = shots(SHAPES["waves on a slope"], rng, ANGLES - 3 * DEG, np.array([1.0, 1.021, 0.987]))
    assert within(by_slopes(light, gain_sigma=0.03), -3 * DEG)


def test_four_shots_have_the_same_turn(rng: np.random.Generator) -> None:
    angle = np.radians([0.0, 45.0, 90.0, 135.0])
    found = by_slopes(shots(SHAPES["saddle"], rng, angle + 2 * DEG), angle=angle)
    assert within(found, 2 * DEG) and found.sigma < 2 / 3 * DEG


def test_mirror_reflection_and_planes_leave_the_turn_unknown(rng: np.random.Generator) -> None:
    assert by_slopes(shots(SHAPES["waves on a slope"], rng, ANGLES + np.pi / 2)).sigma > DEG
    plane = shots(lambda x, y: 0.4 * x, rng)
    assert by_slopes(plane).sigma > DEG
    assert ring_zero.by_slopes(plane, np.zeros(plane.shape[1:], bool), ANGLES, 0.001) == ring_zero.UNKNOWN


def test_two_measurements_are_averaged_by_their_errors_or_doubted() -> None:
    both = ring_zero.combined(RingZero(0.02, 0.004), RingZero(0.024, 0.003))
    assert both.offset == pytest.approx((0.02 / 16 + 0.024 / 9) / (1 / 16 + 1 / 9))
    assert both.sigma == pytest.approx(1.6 * 0.0024)
    different = ring_zero.combined(RingZero(0.0, 0.004), RingZero(0.05, 0.003))
    assert different.sigma == pytest.approx(1.6 * 0.024)  # ten times the distance that their errors let expect


@pytest.mark.parametrize("turn", [7.0, -2.5])
def test_a_ring_whose_zero_is_off_is_found_and_corrected(turn):
    misset = misstated(ANGLES + turn * DEG, ANGLES)
    found = solve(misset)
    assert within(found.ring, turn * DEG) and found.ring.sigma < 0.7 * DEG
    assert found.ring.correction == found.ring.offset
    assert found.angle == pytest.approx(ANGLES + found.ring.offset)
    right, corrected = (
        stokes.solve(misset, scenes.still(), calibration, scenes.ball_object(), stokes.StokesSettings())
        for calibration in (scenes.equal(ANGLES + turn * DEG), found)
    )
    s1, s2 = (right.stokes - corrected.stokes)[1:].sum(-1)[:, right.mask]
    polarized = np.hypot(*right.stokes[1:].sum(-1)[:, right.mask])
    assert np.hypot(s1, s2).sum() < 2 * DEG * polarized.sum()


def test_a_calibrated_zero_and_the_measured_one_are_averaged_by_their_errors():
    settings = selfcal.SelfcalSettings()
    measured = RingZero(0.6 * DEG, 0.4 * DEG)
    averaged = selfcal.corrected(measured, 0.01 * DEG, settings)
    before = np.hypot(0.01, 0.3)  # a thread's play
    share = before**2 / (before**2 + 0.4**2)
    assert averaged.correction == averaged.offset == pytest.approx(share * 0.6 * DEG)
    assert averaged.sigma == pytest.approx(before * 0.4 / np.hypot(before, 0.4) * DEG)
    vague = selfcal.corrected(RingZero(3 * DEG, 2 * DEG), 0.01 * DEG, settings)
    assert vague.offset == vague.correction == 0 and vague.sigma == pytest.approx(before * DEG)
    another = RingZero(5 * DEG, 0.4 * DEG)  # the filter was screwed on again
    assert selfcal.corrected(another, 0.01 * DEG, settings) == replace(another, correction=another.offset)
    assert selfcal.corrected(measured, None, settings) == measured  # set by eye: within its error


def test_a_ring_set_right_is_not_corrected():
    found = solve(scenes.stack(noise=0.002)).ring
    assert found.correction == 0 and within(found, 0.0)


def test_a_turn_is_corrected_only_where_asked_and_certain():
    misset = misstated(ANGLES + 3 * DEG, ANGLES)
    assert solve(misset, correct_ring=False).ring.correction == 0
    assert solve(replace(misset, equipment=Equipment("one exposure"))).ring.correction == 0
    cut = replace(scenes.ball_object(), border=0.1)  # no closed outline: the slopes alone give the turn
    assert solve(misset, object_=cut).ring.correction == pytest.approx(3 * DEG, abs=0.3 * DEG)
