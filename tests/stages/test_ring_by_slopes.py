"""The ring's zero by the slopes inside: right for any shape that has some curvature, silent where nothing tells."""

import numpy as np
import pytest

from polcap.images import Floats
from polcap.stages.selfcal import ring_by_slopes
from polcap.stages.selfcal.ring_zero import UNKNOWN, RingZero
from tests.stages.test_integrability import ANGLES, SHAPES, shots


def found(light: Floats, gain_sigma: float = 0.001, angle: Floats = ANGLES) -> RingZero:
    inside = np.zeros(light.shape[1:], bool)
    inside[4:-4, 4:-4] = True
    return ring_by_slopes.measure(light, inside, angle, gain_sigma)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_turn_is_the_one_that_makes_slopes_a_heights(shape: str, rng: np.random.Generator) -> None:
    gain = np.array([1.0, 1.001, 0.999])
    turn = found(shots(SHAPES[shape], rng, ANGLES + np.radians(4.0), gain))
    assert abs(turn.turn - np.radians(4.0)) < 3 * turn.sigma
    assert turn.sigma < np.radians(0.6)


def test_gains_that_nobody_knows_well_are_found_with_it(rng: np.random.Generator) -> None:
    gain = np.array([1.0, 1.021, 0.987])
    turn = found(shots(SHAPES["waves on a slope"], rng, ANGLES - np.radians(3.0), gain), gain_sigma=0.03)
    assert abs(turn.turn + np.radians(3.0)) < 3 * turn.sigma


def test_more_than_three_shots_do_as_well(rng: np.random.Generator) -> None:
    angle = np.radians([0.0, 45.0, 90.0, 135.0])
    light = shots(SHAPES["saddle"], rng, angle + np.radians(2.0), np.ones(4))
    turn = found(light, angle=angle)
    assert abs(turn.turn - np.radians(2.0)) < 3 * turn.sigma < np.radians(2.0)


def test_what_lies_across_as_reflections_do_is_no_turn(rng: np.random.Generator) -> None:
    light = shots(SHAPES["waves on a slope"], rng, ANGLES + np.pi / 2, np.ones(3))
    assert found(light).sigma > np.radians(1.0)


def test_an_even_plane_and_a_few_pixels_tell_nothing(rng: np.random.Generator) -> None:
    light = shots(lambda x, y: 0.4 * x, rng, ANGLES, np.ones(3))
    assert found(light).sigma > np.radians(1.0)
    nothing = np.zeros(light.shape[1:], bool)
    assert ring_by_slopes.measure(light, nothing, ANGLES, 0.001) == UNKNOWN


def test_two_answers_are_joined_by_their_errors_or_doubted() -> None:
    both = ring_by_slopes.joined(RingZero(0.02, 0.004), RingZero(0.024, 0.003))
    assert both.turn == pytest.approx((0.02 / 16 + 0.024 / 9) / (1 / 16 + 1 / 9))
    assert both.sigma == pytest.approx(0.0024)
    apart = ring_by_slopes.joined(RingZero(0.0, 0.004), RingZero(0.05, 0.003))
    assert apart.sigma == pytest.approx(0.024)  # ten times as far apart as they should be
