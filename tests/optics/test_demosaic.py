"""Binning and interpolation are linear, unbiased, and know what they do to noise."""

import numpy as np
import pytest

from polcap.optics import demosaic

RGGB = np.array([[0, 1], [1, 2]], np.uint8)
X_TRANS = np.array([[1, 2, 1, 1, 0, 1], [0, 1, 0, 2, 1, 2], [1, 2, 1, 1, 0, 1],
                    [1, 0, 1, 1, 2, 1], [2, 1, 2, 0, 1, 0], [1, 0, 1, 1, 2, 1]], np.uint8)  # fmt: skip
PHASES = [RGGB, RGGB[::-1], RGGB[:, ::-1], RGGB[::-1, ::-1]]


def mosaic_of(picture, cfa):
    h, w = picture.shape[:2]
    return np.take_along_axis(picture, np.tile(cfa, (h // 2, w // 2))[..., None].astype(int), 2)[..., 0]


def binned_colors(mosaic, cfa):
    return np.moveaxis(demosaic.superpixel(mosaic, cfa), 0, -1)


@pytest.mark.parametrize("cfa", PHASES)
def test_each_photosite_lands_in_its_colour(cfa):
    flat = np.broadcast_to(np.array([100, 200, 300], np.float32), (12, 16, 3))
    np.testing.assert_array_equal(binned_colors(mosaic_of(flat, cfa), cfa), flat[:6, :8])
    np.testing.assert_allclose(demosaic.interpolate(mosaic_of(flat, cfa), cfa), flat, rtol=1e-6)


def test_odd_row_and_column_are_dropped():
    assert demosaic.superpixel(np.ones((7, 9), np.uint16), RGGB).shape == (3, 3, 4)


def test_green_is_the_mean_of_both():
    quad = np.array([[10, 20], [40, 80]], np.uint16)
    np.testing.assert_array_equal(demosaic.superpixel(quad, RGGB)[:, 0, 0], [10, 30, 80])


@pytest.mark.parametrize("cfa", PHASES)
def test_superpixel_center_is_half_a_photosite_in(cfa):
    """A ramp a + bx + cy read at (2i + ½, 2j + ½), to the phase of each colour's own photosites."""
    y, x = np.mgrid[:16, :16].astype(np.float32)
    binned = binned_colors(3 * x + 5 * y, cfa)
    yy, xx = np.mgrid[:8, :8].astype(np.float32)
    np.testing.assert_allclose(binned[..., 1], 3 * (2 * xx + 0.5) + 5 * (2 * yy + 0.5), atol=1e-4)


def test_x_trans_block_is_one_pixel_with_every_color_in_its_middle():
    """Ramps of three slopes, read at the blocks' middles (3i + 1, 3j + 1); a cut block is dropped."""
    y, x = np.mgrid[:25, :32].astype(np.float32)
    ramp = np.stack([3 * x + 5 * y, x - 2 * y + 90, 4 * y + 7], -1)
    colors = np.tile(X_TRANS, (5, 6))[:25, :32]
    binned = binned_colors(np.take_along_axis(ramp, colors[..., None].astype(int), 2)[..., 0], X_TRANS)
    np.testing.assert_allclose(binned, ramp[1:24:3, 1:30:3], atol=1e-4)


def test_x_trans_is_distinguished_from_other_mosaics():
    for shift in ((0, 0), (1, 2), (5, 4)):
        down, right = demosaic.x_trans_corner(np.roll(X_TRANS, shift, (0, 1)))
        assert ((down - shift[0]) % 3, (right - shift[1]) % 3) == (0, 0)
    assert demosaic.x_trans_corner(np.tile(RGGB, (3, 3))) is None


@pytest.mark.parametrize("cfa", PHASES)
def test_interpolation_is_exact_on_ramps_and_keeps_measured_values(cfa):
    y, x = np.mgrid[:24, :32].astype(np.float32)
    ramp = np.stack([3 * x + 5 * y, x - 2 * y + 90, 4 * y + 7], -1)
    full = demosaic.interpolate(mosaic_of(ramp, cfa), cfa)
    np.testing.assert_allclose(full[4:-4, 4:-4], ramp[4:-4, 4:-4], atol=1e-3)  # float32 at 200
    noise = np.random.default_rng(0).normal(size=(24, 32)).astype(np.float32)
    np.testing.assert_allclose(mosaic_of(demosaic.interpolate(noise, cfa), cfa), noise, atol=1e-6)


@pytest.mark.parametrize("cfa", PHASES)
def test_variance_gain_predicts_the_noise(cfa):
    """Colours of unlike variance; 6·10⁴ samples per phase know a variance to 1.2 %, 4σ."""
    rng = np.random.default_rng(1)
    sigma = np.array([1.0, 2.0, 3.0])
    noise = rng.normal(size=(512, 512, 3)) * sigma
    full = demosaic.interpolate(mosaic_of(noise, cfa).astype(np.float32), cfa)[4:-4, 4:-4]
    measured = np.array([[full[i::2, j::2].var(axis=(0, 1)) for j in (0, 1)] for i in (0, 1)])
    np.testing.assert_allclose(measured, demosaic.variance_gain(cfa) @ sigma**2, rtol=0.024)


def test_interpolation_sharper_than_bilinear_on_a_grey_edge():
    """Luminance detail shared by the colours is what the correction term is for."""
    x = np.linspace(0, 60, 240, dtype=np.float32)
    picture = np.repeat(np.tile(100 + 40 * np.sin(x), (64, 1))[..., None], 3, axis=2)
    full = demosaic.interpolate(mosaic_of(picture, RGGB), RGGB)[4:-4, 4:-4]
    error = np.abs(full - picture[4:-4, 4:-4]).max()
    bilinear = (picture[:, :-2, 1] + picture[:, 2:, 1]) / 2 - picture[:, 1:-1, 1]
    assert error < 0.5 * np.abs(bilinear).max()
