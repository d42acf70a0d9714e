"""A ball's outline: the way out is the radius, and a body's light is polarized across the contour."""

import numpy as np
import pytest
from scipy import ndimage

from polcap.image_values import Floats
from polcap.optics import mueller, outline

Y, X = np.mgrid[-40:41, -40:41].astype(float)
DISC = np.hypot(X, Y) < 30
BAND = DISC & (np.hypot(X, Y) > 24)
AZIMUTH = np.arctan2(-Y, X)[BAND]  # rows run down
ANGLES = np.radians([0.0, 60.0, 120.0])


def lit(turned: float, dolp: float = 0.2) -> outline.OutlineBand:
    """A rim polarized by `dolp` across the contour, seen through polarizers that stood `turned` rad further."""
    stokes = np.stack([np.ones_like(AZIMUTH), dolp * np.cos(2 * AZIMUTH), dolp * np.sin(2 * AZIMUTH)])
    light: Floats = mueller.analyzer(ANGLES + turned) @ stokes
    return outline.OutlineBand(light, AZIMUTH, outline.sectors(BAND))


def test_way_out_of_a_disc_is_its_radius() -> None:
    direction, slope = outline.outward(DISC.astype(np.float32), 3.0)
    estimated = np.arctan2(direction[1], direction[0])[BAND & (slope > 1e-4)]
    off = np.angle(np.exp(1j * (estimated - np.arctan2(-Y, X)[BAND & (slope > 1e-4)])))
    assert np.abs(off).max() < 2 / 24  # rad: two pixels of staircase at the inner edge


def test_sectors_part_a_ring_evenly() -> None:
    counts = np.bincount(outline.sectors(BAND), minlength=outline.SECTORS)
    assert len(counts) == outline.SECTORS and counts.min() > 0.6 * counts.mean()


@pytest.mark.parametrize("turned_deg", [-20, 0, 7])
def test_common_turn_of_the_polarizer_is_read_off_the_rim(turned_deg: int) -> None:
    """The stated angles are `turned` too small, so every AoLP is stated that much too small."""
    mean, sigma = outline.mean_and_sigma(*outline.phasor(lit(np.radians(turned_deg)), ANGLES))
    assert abs(mean) == pytest.approx(1, abs=1e-6)
    assert np.degrees(np.angle(mean) / 2) == pytest.approx(-turned_deg, abs=1e-4)
    assert sigma < 1e-6


def test_polarization_is_that_of_the_stokes_parameters() -> None:
    found = outline.polarization(lit(0.0, dolp=0.3), ANGLES)
    np.testing.assert_allclose(found, 0.3 * np.exp(2j * AZIMUTH), atol=1e-9)


def test_what_no_body_emits_weighs_no_more_than_the_most_it_can() -> None:
    usual, beyond = (outline.phasor(lit(0.0, dolp), ANGLES)[1].sum() for dolp in (0.4, 0.9))
    assert beyond == pytest.approx(usual)


def test_no_rim_tells_nothing() -> None:
    empty = outline.OutlineBand(np.zeros((3, 0)), np.zeros(0), np.zeros(0, int))
    assert outline.mean_and_sigma(*outline.phasor(empty, ANGLES)) == (0, np.pi / 2)


def test_pixels_without_a_value_take_that_of_a_nearest_one() -> None:
    known = np.random.default_rng(1).random((40, 60)) < 0.05
    value = np.moveaxis(np.indices(known.shape), 0, -1).astype(np.float32)
    out = outline.fill_outward(value, known)
    assert np.array_equal(out[known], value[known])
    away = np.linalg.norm(out - value, axis=-1)
    assert np.all(away <= 1.05 * ndimage.distance_transform_edt(~known) + 1e-3)


@pytest.mark.parametrize("radius", [8.3, 30.2])
def test_matte_of_a_mask_is_near_the_share_that_the_object_covers(radius: float) -> None:
    fine = (np.arange(96 * 16) + 0.5) / 16 - 0.5
    covered = np.hypot(fine[:, None] - 47.3, fine - 47.6) < radius
    share = covered.reshape(96, 16, 96, 16).mean(axis=(1, 3))
    mask = share > 0.5
    edge = (share > 0) & (share < 1)
    assert np.std(outline.matte(mask)[edge] - share[edge]) < 0.6 * np.std(mask[edge] - share[edge])
    assert outline.matte(np.ones((9, 9), bool)).min() == 1  # the picture's border is no outline
