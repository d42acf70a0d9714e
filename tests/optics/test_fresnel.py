"""Fresnel's equations against textbook numbers."""

import numpy as np
import pytest

from polcap.optics import body, fresnel

ANGLES = np.radians(np.arange(0.0, 90.0, 5.0))


def test_glass_reflects_four_percent_head_on() -> None:
    assert fresnel.normal_reflectance(1.5) == pytest.approx(0.04)
    assert fresnel.normal_reflectance(4 / 3) == pytest.approx(0.0204, abs=1e-4)  # water
    plus, minus = fresnel.reflection(np.array(1.0), 1.5)
    assert plus == pytest.approx(0.04) and minus == pytest.approx(0.0, abs=1e-12)


def test_nothing_of_the_p_wave_is_reflected_at_brewsters_angle() -> None:
    for n in (1.4, 1.5, 1.6):
        plus, minus = fresnel.reflection(np.cos(np.arctan(n)), n)
        assert plus - minus == pytest.approx(0.0, abs=1e-12)  # R_p
        assert plus + minus == pytest.approx(((n**2 - 1) / (n**2 + 1)) ** 2)  # R_s there, Hecht §8.6


@pytest.mark.parametrize("n", [1.3, 1.5, 1.8])
def test_what_is_not_reflected_is_transmitted(n: float) -> None:
    c = np.cos(ANGLES)
    (r_plus, r_minus), (t_plus, t_minus) = fresnel.reflection(c, n), fresnel.transmission(c, n)
    np.testing.assert_allclose(r_plus + t_plus, 1.0, rtol=1e-12)
    np.testing.assert_allclose(r_minus, t_minus, atol=1e-12)  # (R_s − R_p)/2 = (T_p − T_s)/2
    assert (r_minus >= 0).all()


def test_reflectance_at_sixty_degrees() -> None:
    plus, minus = fresnel.reflection(np.cos(np.radians(60.0)), 1.5)
    assert plus + minus == pytest.approx(0.1766, abs=1e-4)  # R_s = ((.5 − √1.5)/(.5 + √1.5))²
    assert plus - minus == pytest.approx(0.0018, abs=1e-4)  # R_p


def test_transmission_falls_as_tabulated() -> None:
    plus, _ = fresnel.transmission(np.cos(np.radians([10, 20, 30, 40, 50, 60, 70, 80])), 1.5)
    np.testing.assert_allclose(plus, [0.960, 0.960, 0.958, 0.954, 0.942, 0.911, 0.829, 0.612], atol=6e-4)


@pytest.mark.parametrize(
    ("n", "expected"),
    [
        (1.4, [0.0013, 0.0052, 0.0126, 0.0246, 0.0437, 0.0740, 0.1224, 0.2004]),
        (1.5, [0.0017, 0.0071, 0.0170, 0.0329, 0.0577, 0.0959, 0.1551, 0.2464]),
        (1.6, [0.0022, 0.0090, 0.0213, 0.0411, 0.0713, 0.1169, 0.1857, 0.2886]),
    ],
)
def test_diffuse_dolp_is_that_of_atkinson_and_hancock(n: float, expected: list[float]) -> None:
    theta = np.radians([10, 20, 30, 40, 50, 60, 70, 80])
    np.testing.assert_allclose(body.dolp(np.cos(theta), 0.0, n), expected, atol=6e-5)
    sin2 = np.sin(theta) ** 2
    closed = (n - 1 / n) ** 2 * sin2
    closed /= 2 + 2 * n**2 - (n + 1 / n) ** 2 * sin2 + 4 * np.cos(theta) * np.sqrt(n**2 - sin2)
    np.testing.assert_allclose(body.dolp(np.cos(theta), 0.0, n), closed, rtol=1e-12)


@pytest.mark.parametrize("n", [1.3, 1.5, 1.7])
def test_zenith_comes_back_from_the_dolp(n: float) -> None:
    theta = np.radians(np.linspace(1, 89, 89))
    found = fresnel.cos_zenith_from_dolp(body.dolp(np.cos(theta), 0.0, n), n)
    np.testing.assert_allclose(np.degrees(np.arccos(found)), np.degrees(theta), atol=1e-6)


def test_dolp_beyond_the_material_is_grazing_and_none_is_head_on() -> None:
    assert fresnel.greatest_diffuse_dolp(1.5) == pytest.approx(0.3846, abs=1e-4)
    cosine = fresnel.cos_zenith_from_dolp(np.array([-0.1, 0.0, 0.5, 1.0]), 1.5)
    np.testing.assert_allclose(cosine[:2], 1.0, atol=1e-9)
    assert (cosine[2:] < 0.01).all()
