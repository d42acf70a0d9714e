"""Gains from slopes that are those of a height: right for any shape that has some curvature, silent elsewhere."""

from collections.abc import Callable

import numpy as np
import pytest

from polcap.images import Floats
from polcap.optics import fresnel, mueller
from polcap.stages.selfcal import integrability
from polcap.stages.selfcal.object_gains import Estimate

ANGLES = np.radians([0.0, 45.0, 90.0])
TRUE = np.array([1.0, 1.021, 0.987])
SIZE = 120
Height = Callable[[Floats, Floats], Floats]
SHAPES: dict[str, Height] = {  # −1…1 both, y up; every one without a place that faces the camera but the first
    "ball, seen from the front": lambda x, y: np.sqrt(np.maximum(2.0 - x**2 - y**2, 0.1)),
    "leaning ridge": lambda x, y: 0.35 * x + 0.25 * np.cos(2.2 * y),
    "saddle": lambda x, y: 0.35 * x**2 - 0.15 * y**2 + 0.3 * x,
    "waves on a slope": lambda x, y: 0.3 * y + 0.08 * np.sin(4 * x) * np.cos(3 * y),
}


def shots(height: Height, random: np.random.Generator, angle: Floats = ANGLES, gain: Floats = TRUE) -> Floats:
    """What polarizers at angles (K,) show of a smooth body under an even light, with a checkered albedo: (K, H, W)."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(1, -1, SIZE))
    step = 1e-4
    slope_x, slope_y = (
        (height(x + dx, y + dy) - height(x - dx, y - dy)) / (2 * step) for dx, dy in ((step, 0.0), (0.0, step))
    )
    cosine = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    dolp = fresnel.diffuse_dolp(cosine, 1.5)
    azimuth = np.arctan2(slope_y, slope_x)
    s0 = (0.4 + 0.4 * (np.sin(9 * x) * np.sin(7 * y) > 0)) * cosine
    stokes = np.stack([s0, s0 * dolp * np.cos(2 * azimuth), s0 * dolp * np.sin(2 * azimuth)])
    light = np.einsum("kj,jhw->khw", mueller.analyzer(angle), stokes) * gain[:, None, None]
    return np.asarray(light * (1 + 5e-4 * random.normal(size=light.shape)))


def asked(light: Floats, angle: Floats = ANGLES) -> Estimate:
    inside = np.zeros(light.shape[1:], bool)
    inside[4:-4, 4:-4] = True
    return integrability.gains(light, inside, angle, np.ones(len(angle)))


@pytest.mark.parametrize("shape", SHAPES)
def test_gains_are_those_that_make_the_slopes_a_heights(shape: str, rng: np.random.Generator) -> None:
    found = asked(shots(SHAPES[shape], rng))
    np.testing.assert_allclose(found.gain, TRUE, atol=2e-3)
    assert found.sigma[0] == 0 and np.all(found.sigma[1:] < 0.01)
    assert np.all(np.abs(found.gain - TRUE)[1:] < 3 * found.sigma[1:])


def test_any_three_angles_do(rng: np.random.Generator) -> None:
    angle = np.radians([10.0, 60.0, 150.0])
    np.testing.assert_allclose(asked(shots(SHAPES["leaning ridge"], rng, angle), angle).gain, TRUE, atol=2e-3)


def test_a_common_turn_of_the_angles_does_not_matter(rng: np.random.Generator) -> None:
    found = asked(shots(SHAPES["ball, seen from the front"], rng, ANGLES + np.radians(4)))
    np.testing.assert_allclose(found.gain, TRUE, atol=2e-3)


def test_a_large_picture_tells_the_same(rng: np.random.Generator) -> None:
    light = np.kron(shots(SHAPES["saddle"], rng), np.ones((1, 4, 4)))
    np.testing.assert_allclose(asked(light).gain, TRUE, atol=2e-3)


def test_what_has_no_slopes_of_one_surface_tells_nothing(rng: np.random.Generator) -> None:
    turned = shots(SHAPES["ball, seen from the front"], rng)
    mixed = rng.permutation(turned.reshape(3, -1).T).T.reshape(turned.shape)
    harmonic = shots(lambda x, y: 0.25 * x * y + 0.3 * x, rng)  # its slopes are a height's with any gains
    for light in (mixed, harmonic, np.ones((3, SIZE, SIZE)) * TRUE[:, None, None], turned[:, :15, :15]):
        assert np.all(np.isinf(asked(light).sigma[1:]))
