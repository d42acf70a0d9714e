"""Errors of the shots' gains tilt normals as Fresnel's equations and Malus' law say."""

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.optics import fresnel, mueller
from polcap.quality import gain_cost

ANGLE = np.radians([0.0, 45.0, 90.0])
OF_NETWORK = gain_cost._OF_NETWORK


def dolp(zenith: Floats) -> Floats:
    """DoLP of diffuse reflection with index 1.5, from half the sum and half the difference of the transmittances."""
    mean, difference = fresnel.transmission(np.cos(zenith), 1.5)
    return np.asarray(difference / mean)


def test_a_facing_normal_tilts_until_its_polarization_is_the_false_one() -> None:
    """An error ε of the shot at 45° alone adds S2/S0 = ε: the sum of 0° and 90° gives S0."""
    zenith = np.radians(24.0)
    facing = np.full((2, 500), 1e-9)
    cost = gain_cost.normal_error_deg(facing, ANGLE, np.array([0.0, abs(float(dolp(zenith))), 0.0]))
    # the tilt grows as the root of the error, and the mean size of a Gaussian error is √(2/π) of its 1σ
    assert cost / OF_NETWORK == pytest.approx(24.0 * (2 / np.pi) ** 0.25, rel=0.05)


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.03])
@pytest.mark.parametrize("degrees", [20.0, 40.0, 60.0])
def test_the_cost_is_the_error_of_normals_from_shots_with_wrong_gains(degrees: float, sigma: float) -> None:
    """Shots of surfaces of one tilt and all azimuths by Malus' law, times random gains, inverted again."""
    random = np.random.default_rng(1)
    azimuth = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    share = abs(float(dolp(np.radians(degrees))))
    stokes = np.stack([np.ones(90), share * np.cos(2 * azimuth), share * np.sin(2 * azimuth)])
    shots = mueller.analyzer(ANGLE) @ stokes
    errors = []
    for gain in 1 + sigma * random.normal(size=(400, 2)):
        s0, s1, s2 = np.linalg.solve(mueller.analyzer(ANGLE), shots * np.array([1.0, *gain])[:, None])
        errors.append(gain_cost._tilt(stokes[1:], np.stack([s1, s2]) / s0))
    measured = np.degrees(np.median(np.sqrt(np.mean(np.square(errors), axis=0))))
    stated = gain_cost.normal_error_deg(stokes[1:], ANGLE, np.array([0.0, sigma, sigma])) / OF_NETWORK
    assert stated == pytest.approx(measured, rel=0.12)


def test_equal_light_instead_of_the_gains_costs_the_tilt_between_both() -> None:
    """Of a surface that faces the camera, the shot at 45° was divided by a gain that it did not have."""
    false = abs(float(dolp(np.radians(24.0))))
    shots = np.array([0.5, 0.5 / (1 - false), 0.5])
    s0, s1, s2 = np.linalg.solve(mueller.analyzer(ANGLE), shots)
    measured = np.tile([[s1 / s0], [s2 / s0]], 200)
    cost = gain_cost.other_gains_deg(measured, ANGLE, np.log([1.0, 1 - false, 1.0]))
    assert cost / OF_NETWORK == pytest.approx(24.0, rel=0.1)  # a rest of 1 % of the error leaves a tenth of the tilt


def test_well_polarized_surfaces_lose_little() -> None:
    sigma, azimuth = np.array([0.0, 0.02, 0.02]), np.linspace(0, 2 * np.pi, 90)
    cost = [
        gain_cost.normal_error_deg(share * np.stack([np.cos(azimuth), np.sin(azimuth)]), ANGLE, sigma)
        for share in (0.005, 0.02, 0.1)
    ]
    assert cost[0] > 25 > cost[1] > 12 > cost[2]
