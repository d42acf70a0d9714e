"""Robust statistics are right on normal noise and little moved by outliers."""

import numpy as np
import pytest

from polcap.optics import robust


def test_spread_of_normal_noise_is_its_standard_deviation(rng: np.random.Generator) -> None:
    noise = 0.3 * rng.normal(size=20_000)
    assert robust.spread(noise) == pytest.approx(0.3, rel=0.03)
    noise[:2000] += 100
    assert robust.spread(noise) == pytest.approx(0.3, rel=0.2)


def test_biweight_ends_at_4_685_sigma() -> None:
    weight = robust.biweight(np.array([0.0, 4.685 / 2, 4.685, 100.0]) * 0.1, 0.1)
    assert weight == pytest.approx([1.0, 0.75**2, 0.0, 0.0])


def test_jackknife_of_a_mean_is_its_standard_error(rng: np.random.Generator) -> None:
    """σ/√N, exactly (Efron 1982); axes behind the first are separate estimates."""
    value = rng.normal(size=(50, 3))
    without = (value.sum(axis=0) - value) / 49
    assert robust.jackknife(without) == pytest.approx(value.std(axis=0, ddof=1) / np.sqrt(50))


@pytest.mark.parametrize("slope, floor", [(2e-4, 1e-6), (1e-3, 1e-4)])
def test_noise_line_is_found_within_its_error(slope: float, floor: float, rng: np.random.Generator) -> None:
    signal = np.linspace(0.001, 1, 400)
    freedom = 255
    variance = (slope * signal + floor) * rng.chisquare(freedom, 400) / freedom
    found = robust.fit_noise_line(signal, variance, freedom, least=floor / 5)
    sigma = np.sqrt(np.diag(found.covariance))
    assert abs(found.slope - slope) < 4 * sigma[0] < 0.05 * slope
    assert abs(found.floor - floor) < 4 * sigma[1] < 0.3 * floor


def test_edges_are_a_second_cause_of_variance(rng: np.random.Generator) -> None:
    signal, edges = rng.uniform(size=(2, 400))
    found = robust.fit_noise_line(signal, 2e-4 * signal + 1e-5 + 0.01 * edges, 255, least=1e-9, edges=edges)
    assert (found.slope, found.floor) == pytest.approx((2e-4, 1e-5))


def test_outliers_hardly_move_the_line(rng: np.random.Generator) -> None:
    signal = rng.uniform(size=500)
    variance = (2e-4 * signal + 1e-5) * rng.chisquare(100, 500) / 100
    variance[::20] *= 30
    found = robust.fit_noise_line(signal, variance, 100, least=1e-6, outliers=True)
    assert (found.slope, found.floor) == pytest.approx((2e-4, 1e-5), rel=0.1)


def test_the_floor_is_not_below_rounding(rng: np.random.Generator) -> None:
    signal = np.linspace(0.1, 1, 100)
    found = robust.fit_noise_line(signal, 2e-4 * signal - 1e-6, 100, least=1e-6, least_floor=1e-6)
    assert found.floor == 1e-6 and found.slope == pytest.approx(2e-4, rel=0.05)


def test_one_level_of_signal_determines_no_line() -> None:
    found = robust.fit_noise_line(np.full(50, 0.3), np.full(50, 1e-4), 100, least=1e-6)
    assert np.isnan([found.slope, found.floor]).all()
