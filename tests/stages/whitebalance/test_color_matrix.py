"""The color matrix of charts under known light."""

import numpy as np
import pytest

from polcap.formats import shipped_data
from polcap.stages.whitebalance import chart
from polcap.stages.whitebalance.color_matrix import fit_matrix

POSITION = chart.centers() - chart.centers()[18]
REFERENCE = shipped_data.colorchecker().rec709
CAMERA = np.array([[0.28, 0.10, 0.07], [0.08, 0.71, 0.22], [0.02, 0.18, 0.66]])  # linear Rec.709 → camera
ALL = np.ones(24, bool)


def seen(matrix, slope=(0.0, 0.0), glare=0.0):
    """The chart's patches in a camera under sloping light and a white veil."""
    return ((1 + POSITION @ np.array(slope))[:, None] * REFERENCE + glare) @ matrix.T


def test_matrix_slope_and_glare_of_a_linear_camera_are_recovered():
    fit = fit_matrix(seen(0.3 * CAMERA, (0.03, -0.02), 0.015), REFERENCE, POSITION, ALL)
    assert fit.matrix @ (0.3 * CAMERA) == pytest.approx(np.eye(3), abs=1e-9)  # exact algebra in float64
    assert fit.slope == pytest.approx([0.03, -0.02], abs=1e-9)
    assert fit.glare == pytest.approx(0.015, abs=1e-9)
    assert fit.delta_e.max() < 1e-6


def test_matrix_commutes_with_exposure():
    noisy = seen(CAMERA) * np.random.default_rng(1).normal(1, 0.02, (24, 3))
    fits = [fit_matrix(k * noisy, REFERENCE, POSITION, ALL) for k in (1, 1000)]
    assert 1000 * fits[1].matrix == pytest.approx(fits[0].matrix, rel=1e-6)
    assert fits[1].delta_e == pytest.approx(fits[0].delta_e, rel=1e-6)


@pytest.mark.parametrize("patch", [0, 8, 15, 19])
def test_a_label_or_a_highlight_on_one_patch_hardly_moves_the_matrix(patch):
    patches = seen(CAMERA) * np.random.default_rng(2).normal(1, 0.005, (24, 3))
    clean = fit_matrix(patches, REFERENCE, POSITION, ALL)
    patches[patch] *= 1.5
    fit = fit_matrix(patches, REFERENCE, POSITION, ALL)
    assert fit.matrix @ CAMERA == pytest.approx(clean.matrix @ CAMERA, abs=0.02)
    assert fit.delta_e.argmax() == patch


def test_patches_left_out_have_no_say_and_no_residual():
    patches, usable = seen(CAMERA), ALL.copy()
    patches[[18, 19, 15]] = 1.0  # clipped
    usable[[18, 19, 15]] = False
    fit = fit_matrix(patches, REFERENCE, POSITION, usable)
    assert fit.matrix @ CAMERA == pytest.approx(np.eye(3), abs=1e-8)
    assert np.array_equal(np.isnan(fit.delta_e), ~usable)
