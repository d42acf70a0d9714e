"""Blur is measured on the scene's own detail, whatever that is."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter1d

from polcap.image_values import Floats
from polcap.optics import sharpness
from polcap.optics.sharpness import TILE


def scene(seed: int = 0) -> Floats:
    random = np.random.default_rng(seed)
    detail = gaussian_filter(random.normal(size=(256, 384)), 1.2) * 4
    return np.asarray(np.exp(0.3 * detail), np.float32) / 4


def measured(pictures: list[Floats], noise: float = 0.002) -> Floats:
    random = np.random.default_rng(1)
    noisy = [np.asarray(p + noise * random.normal(size=p.shape), np.float32) for p in pictures]
    corners = sharpness.choose_tiles(noisy[0], np.ones(noisy[0].shape, bool))
    tiles = np.stack([[p[y : y + TILE, x : x + TILE] for y, x in corners] for p in noisy])
    return sharpness.extra_blur(tiles, np.ones(tiles.shape[:2], bool))


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_defocus_is_measured_in_pixels(sigma: float) -> None:
    sharp = scene()
    blur = measured([sharp, gaussian_filter(sharp, sigma), 0.8 * sharp])
    assert blur[1] == pytest.approx(sigma, rel=0.15)
    assert max(blur[0], blur[2]) < 0.4


def test_few_noisy_tiles_of_one_scene_show_no_blur() -> None:
    """The loss of detail of some photograph along some way is always the greatest; its scatter says that it is none."""
    corners = sharpness.choose_tiles(scene(), np.ones((256, 384), bool))[:4]
    tiles = np.stack([scene()[y : y + TILE, x : x + TILE] for y, x in corners])
    random = np.random.default_rng(3)
    noisy = tiles + 0.03 * random.normal(size=(20, 4, *tiles.shape))  # twenty captures of four shots
    blur = np.array([sharpness.extra_blur(one, np.ones((4, 4), bool)).max() for one in noisy.astype(np.float32)])
    assert (blur > 0.2).sum() <= 5


def test_blur_that_spares_tiles_without_detail_is_reported() -> None:
    """Half of the tiles are nearly flat: noise is all that blur could take from them."""
    half = np.where(np.arange(384) < 192, scene(), 0.25 + 0.04 * (scene() - 0.25)).astype(np.float32)
    blur = measured([half, gaussian_filter(half, 2.0), half, half])
    assert blur[1] > 0.8 and max(blur[0], blur[2], blur[3]) < 0.4


def test_motion_along_one_direction_counts_as_its_standard_deviation() -> None:
    sharp = scene()
    blur = measured([sharp, sharp, uniform_filter1d(sharp, 7, axis=0)])
    assert blur[2] == pytest.approx(7 / np.sqrt(12), rel=0.3)


def test_pictures_without_detail_tell_nothing() -> None:
    flat = np.full((256, 384), 0.3, np.float32)
    assert np.isnan(measured([flat, flat, flat])).all()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shift", [0.25, 0.5])
def test_a_shift_of_edges_along_the_pixel_rows_is_no_blur(shift: float, turned: bool) -> None:
    """An edge is sharpest between two rows, so a camera that moved by half a pixel shows it blurred."""
    rows = np.where(np.abs(np.arange(256) - 127.5) < 60, 0.4, 0.03)
    sharp = np.repeat(rows[:, None], 384, axis=1)
    moved = (1 - shift) * sharp + shift * np.roll(sharp, 1, axis=0)
    pictures = [sharp, moved, gaussian_filter(sharp, 2.0)]
    blur = measured([picture.T if turned else picture for picture in pictures])
    assert blur[:2].max() < 0.2 and blur[2] > 0.8
