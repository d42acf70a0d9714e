"""Gains from slopes that are those of a height: right for any shape with some curvature, unknown elsewhere."""

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.stages.selfcal import integrability
from polcap.stages.selfcal.object_gains import GainEstimate
from tests.stages.selfcal.shapes import ANGLES, SHAPES, SIZE, inside, shots

TRUE = np.array([1.0, 1.021, 0.987])


def gains(light: Floats, angle: Floats = ANGLES) -> GainEstimate:
    return integrability.gains(light, inside(light), angle, np.ones(len(angle)))


@pytest.mark.parametrize("shape", SHAPES)
def test_gains_are_those_that_make_the_slopes_a_heights(shape: str, rng: np.random.Generator) -> None:
    found = gains(shots(SHAPES[shape], rng, gain=TRUE))
    np.testing.assert_allclose(found.gain, TRUE, atol=2e-3)
    assert found.sigma[0] == 0 and np.all(found.sigma[1:] < 0.01)
    assert np.all(np.abs(found.gain - TRUE)[1:] < 3 * found.sigma[1:])


def test_gains_are_found_at_any_three_angles(rng: np.random.Generator) -> None:
    angle = np.radians([10.0, 60.0, 150.0])
    np.testing.assert_allclose(gains(shots(SHAPES["leaning ridge"], rng, angle, TRUE), angle).gain, TRUE, atol=2e-3)


def test_a_common_turn_of_the_angles_leaves_the_gains(rng: np.random.Generator) -> None:
    found = gains(shots(SHAPES["ball, seen from the front"], rng, ANGLES + np.radians(4), TRUE))
    np.testing.assert_allclose(found.gain, TRUE, atol=2e-3)


def test_a_large_picture_has_the_same_gains(rng: np.random.Generator) -> None:
    light = np.kron(shots(SHAPES["saddle"], rng, gain=TRUE), np.ones((1, 4, 4)))
    np.testing.assert_allclose(gains(light).gain, TRUE, atol=2e-3)


def test_without_slopes_of_one_surface_gains_are_unknown(rng: np.random.Generator) -> None:
    ball = shots(SHAPES["ball, seen from the front"], rng, gain=TRUE)
    mixed = rng.permutation(ball.reshape(3, -1).T).T.reshape(ball.shape)
    harmonic = shots(lambda x, y: 0.25 * x * y + 0.3 * x, rng, gain=TRUE)  # its slopes are a height's with any gains
    for light in (mixed, harmonic, np.ones((3, SIZE, SIZE)) * TRUE[:, None, None], ball[:, :15, :15]):
        assert np.all(np.isinf(gains(light).sigma[1:]))
