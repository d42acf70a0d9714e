"""Sub-pixel motion between two frames, and honesty where there is nothing to see."""

import numpy as np
import pytest
from scipy import ndimage

from polcap.optics.projection import transform_points
from polcap.optics.registration import Pyramid, register, scaled


def _texture():
    """Detail of many sizes, none finer than a sensor behind a lens shows."""
    rng = np.random.default_rng(99)
    fields = [ndimage.gaussian_filter(rng.normal(size=(800, 900)), s) for s in (1.5, 4, 12, 40)]
    return ndimage.spline_filter(sum(f / f.std() for f in fields) * 0.15)


TEXTURE = _texture()


def view(rng, matrix, noise=0.01, size=(480, 600)):
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    p = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(matrix).T
    x, y = p[..., 0] / p[..., 2] + 150, p[..., 1] / p[..., 2] + 160
    picture = 1 + ndimage.map_coordinates(TEXTURE, [y, x], prefilter=False)
    return (picture + rng.normal(0, noise, size)).astype(np.float32)


def registered(reference, other):
    """Registration of two pictures, all of whose pixels are usable."""
    usable = np.ones(reference.shape, bool)
    return register(Pyramid(reference, usable), Pyramid(other, usable))


def error_px(found, true):
    """Greatest error of a registration near the corners and in the middle."""
    points = np.array([[40, 40], [560, 40], [40, 440], [300, 240]], float)
    return np.abs(transform_points(found.matrix, points) - transform_points(true, points)).max()


MOTIONS = {
    "none": np.eye(3),
    "shift": np.array([[1, 0, 6.4], [0, 1, -3.7], [0, 0, 1.0]]),
    "far": np.array([[1, 0, -41.3], [0, 1, 27.8], [0, 0, 1.0]]),
    "turn": np.array([[0.99998, -0.006, 4.0], [0.006, 0.99998, 1.0], [0, 0, 1.0]]),
    "tilt": np.array([[1.002, 0.001, 2.0], [-0.001, 1.001, -4.0], [3e-6, -2e-6, 1.0]]),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_is_recovered_to_a_fiftieth_of_a_pixel(name):
    rng = np.random.default_rng(0)
    found = registered(view(rng, np.eye(3)), view(rng, MOTIONS[name]))
    assert error_px(found, MOTIONS[name]) < 0.02
    assert found.sigma_px < 0.02


def test_motions_of_averaged_pixels_are_those_of_the_full_grid():
    """The middle of a block of step px is half of step − 1 px from its first pixel's."""
    small = np.array([[3.0, 5.0], [40.0, 11.0]])
    moved = transform_points(scaled(MOTIONS["tilt"], 4), 4 * small + 1.5)
    np.testing.assert_allclose(moved, 4 * transform_points(MOTIONS["tilt"], small) + 1.5)


def test_parts_that_move_on_their_own_are_outvoted():
    rng = np.random.default_rng(1)
    a, b = view(rng, np.eye(3)), view(rng, MOTIONS["shift"])
    b[100:250, 100:300] = view(rng, MOTIONS["turn"])[120:270, 150:350]
    assert error_px(registered(a, b), MOTIONS["shift"]) < 0.03


@pytest.mark.parametrize("ramp", [0.0, 0.004])
def test_noise_alone_shows_no_motion(ramp):
    """Nor does a smooth ramp, whose shift looks like a gain."""
    rng = np.random.default_rng(2)
    x = np.exp(ramp * np.arange(400))[None] * np.ones((300, 1))
    a, b = ((x + rng.normal(0, 0.05, x.shape)).astype(np.float32) for _ in range(2))
    found = registered(a, b)
    assert found.shift_px < max(0.05, 3 * found.sigma_px)


def test_repeated_detail_is_matched_in_the_nearest_place():
    """A staircase of equal steps in the logarithm looks the same, but for its gain, one step on."""
    rng = np.random.default_rng(3)
    stairs = np.exp(np.arange(600) // 30 / 3)[None] * np.ones((480, 1))
    a, b = (np.sqrt(rng.poisson(100 * stairs * e) / 100).astype(np.float32) for e in (1, 0.25))
    found = registered(a, b)
    assert found.shift_px < max(0.05, 3 * found.sigma_px)


def test_nothing_usable_means_no_motion():
    a = np.ones((300, 400), np.float32)
    blind = Pyramid(a, np.zeros(a.shape, bool))
    found = register(blind, blind)
    assert found.tiles == 0 and np.array_equal(found.matrix, np.eye(3))


@pytest.mark.filterwarnings("error")
def test_even_picture_shows_no_motion():
    """All dark, all clipped or a grey card: nothing to compare, and nothing divided by nothing."""
    even = np.full((128, 160), 0.5, np.float32)
    textured = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=even.shape), 2).astype(np.float32)
    for other in (even, textured):
        assert np.array_equal(registered(even, other).matrix, np.eye(3))
