"""The analyzer against Malus's law and the polarizer's Mueller matrix."""

import numpy as np
import pytest

from polcap.optics import mueller


def linear(angle: float) -> np.ndarray:
    """Stokes vector of fully polarized light of unit power vibrating at `angle` from right towards up."""
    return np.array([1.0, np.cos(2 * angle), np.sin(2 * angle)])


def test_malus_law() -> None:
    for vibration in np.radians([0, 30, 100, 165]):
        for axis in np.radians([0, 20, 45, 90, 135]):
            passed = mueller.analyzer(np.array(axis)) @ linear(vibration)
            assert passed == pytest.approx(np.cos(axis - vibration) ** 2, abs=1e-12)


def test_signs_of_the_three_shots() -> None:
    """S1 = I₀ − I₉₀, S2 = 2 I₄₅ − S0: horizontal and up-right are positive."""
    i0, i45, i90 = mueller.analyzer(np.radians([0.0, 45.0, 90.0])) @ np.array([1.0, 0.3, 0.2])
    assert (i0 + i90, i0 - i90, 2 * i45 - i0 - i90) == pytest.approx((1.0, 0.3, 0.2))


def test_unpolarized_light_is_halved_at_every_angle() -> None:
    weights = mueller.analyzer(np.linspace(0, np.pi, 7))
    np.testing.assert_allclose(weights @ np.array([1.0, 0, 0]), 0.5)


def test_first_row_of_the_rotated_mueller_matrix() -> None:
    """P(a) = C(−a) P(0) C(a), Collett ch. 5."""
    for a in np.radians([10, 77, 130]):
        c, s = np.cos(2 * a), np.sin(2 * a)
        turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
        matrix = turn.T @ (0.5 * np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]])) @ turn
        np.testing.assert_allclose(mueller.analyzer(np.array(a)), matrix[0], atol=1e-12)


@pytest.mark.parametrize("ratio", [30.0, 1000.0])
def test_extinction_ratio_is_crossed_over_parallel(ratio: float) -> None:
    crossed, parallel = mueller.analyzer(np.radians([90.0, 0.0]), ratio) @ linear(0.0)
    assert parallel / crossed == pytest.approx(ratio)
