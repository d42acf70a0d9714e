"""A lens's distortion is the textbook's, its inverse undoes it, and pictures are resampled once through it."""

import cv2
import numpy as np
import pytest

from polcap.image_values import Distortion, View
from polcap.optics import distortion
from polcap.optics.warp import covered, warp
from polcap.synth import forward_camera as simulated

BARREL = Distortion(500.0, (150.0, 100.0), -0.2, 0.05)


def test_barrel_pulls_corners_in_as_brown_says():
    x, y = distortion.distort(BARREL, np.array([150.0, 400.0]), np.array([100.0, 100.0]))
    r2 = 0.25  # 250 px are half a focal length
    assert x == pytest.approx([150.0, 150 + 250 * (1 - 0.2 * r2 + 0.05 * r2**2)])
    assert y == pytest.approx([100.0, 100.0])


def test_as_opencv_projects():
    point = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.2]])
    camera = np.array([[500.0, 0, 150], [0, 500, 100], [0, 0, 1]])
    expected = cv2.projectPoints(point, np.zeros(3), np.zeros(3), camera, np.array([-0.2, 0.05, 0, 0]))[0].reshape(2, 2)
    pinhole = point[:, :2] / point[:, 2:] * 500 + [150, 100]
    assert np.transpose(distortion.distort(BARREL, *pinhole.T)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("k1", "k2"), [(-0.2, 0.05), (0.25, 0.1), (0.0, 0.0)])
def test_simulated_lens_is_undone(k1, k2):
    lens = Distortion(500.0, (150.0, 100.0), k1, k2)
    y, x = np.mgrid[:200:25.0, :300:25.0]
    ideal = simulated.undistort(View(500.0, (150.0, 100.0), 1.0), (k1, k2), x, y)
    assert np.allclose(distortion.distort(lens, *ideal), (x, y), atol=1e-4)
    assert np.allclose(distortion.undistort(lens, x, y), ideal, atol=1e-4)


def test_picture_through_a_lens_is_the_pinhole_s():
    """A wave drawn where the lens puts it comes back as drawn by a pinhole; weights and values alike."""
    y, x = np.mgrid[:200, :300].astype(float)
    u, v = distortion.undistort(BARREL, x, y)
    picture = np.sin(u / 7) + np.cos(v / 9)
    box = (20, 30, 260, 170)
    expected = (np.sin(x / 7) + np.cos(y / 9))[30:170, 20:260]
    seen = picture.astype(np.float32)
    assert np.abs(warp(seen, np.eye(3), box, 3, BARREL) - expected).max() < 2e-4
    assert np.abs(warp(seen, np.eye(3), box, 1, BARREL) - expected).max() < 2e-2
    moved = np.array([[1, 0, 3.4], [0, 1, -2.3], [0, 0, 1.0]])
    shot = np.sin(distortion.undistort(BARREL, x - 3.4, y + 2.3)[0] / 7)
    back = warp(shot.astype(np.float32), moved, box, 3, BARREL)
    assert np.abs(back - np.sin(x / 7)[30:170, 20:260]).max() < 2e-4


def test_box_holds_all_that_the_picture_s_box_shows():
    x0, y0, x1, y1 = distortion.pinhole_box(BARREL, (250, 150, 290, 190), (300, 200))
    y, x = np.mgrid[150:190.0, 250:290.0]
    u, v = distortion.undistort(BARREL, x, y)
    assert x0 <= u.min() < x0 + 1.5 and y0 <= v.min() < y0 + 1.5
    assert x1 == min(300, x1) and x1 - 2 < min(u.max(), 299) <= x1 - 1 + 0.5
    assert y1 - 2 < v.max() <= y1 - 1 + 0.5


def test_what_lies_beyond_the_photograph_is_outside():
    pincushion = Distortion(500.0, (150.0, 100.0), 0.4, 0.0)
    seen = covered((200, 300), np.eye(3), (0, 0, 300, 200), lens=pincushion)
    assert seen[100, 150] and not seen[0, 0]


def test_a_lens_that_folds_is_reported():
    assert distortion.folds(Distortion(100.0, (150.0, 100.0), -0.5, 0.0), 300, 200)
    assert not distortion.folds(BARREL, 300, 200)
