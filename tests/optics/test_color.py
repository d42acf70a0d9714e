"""Color against the standard's own numbers, published color-difference pairs and charts of known light."""

import json
import re
import shutil
import subprocess
from importlib import resources

import numpy as np
import pytest

from polcap.formats import shipped_data
from polcap.optics import color
from polcap.optics.colour_science import colour
from polcap.stages.whitebalance import chart

POSITION = chart.centers() - chart.centers()[18]
CAMERA = np.array([[0.28, 0.10, 0.07], [0.08, 0.71, 0.22], [0.02, 0.18, 0.66]])  # linear Rec.709 → camera
ALL = np.ones(24, bool)


def test_srgb_curve_meets_the_standards_values():
    assert color.decode_srgb(np.array([0.0, 10 / 255, 119 / 255, 1.0])) == pytest.approx(
        [0.0, 0.003035, 0.184475, 1.0], abs=1e-6
    )  # IEC 61966-2-1: 10 on the straight part, 119 a mid grey of 18.4 %
    assert color.encode_srgb(np.array([0.0031308])) == pytest.approx([0.04045], abs=1e-5)


def test_srgb_curve_is_inverted_negative_values_too():
    linear = np.linspace(-0.5, 4, 1001)
    assert color.decode_srgb(color.encode_srgb(linear)) == pytest.approx(linear, rel=1e-4, abs=2e-7)


def test_srgb_curve_serves_torch():
    torch = pytest.importorskip("torch")
    value = torch.tensor([-0.2, 0.0, 0.002, 0.4, 1.0], dtype=torch.float64)
    assert color.encode_srgb(value).numpy() == pytest.approx(color.encode_srgb(value.numpy()))


def test_white_of_rec709_is_d65():
    xyz = color.REC709_TO_XYZ @ np.ones(3)
    assert xyz[:2] / xyz.sum() == pytest.approx([0.3127, 0.3290], abs=1e-4)


def test_curve_and_matrix_are_those_of_colour_science():
    srgb, linear = colour.RGB_COLOURSPACES["sRGB"], np.linspace(0, 1, 1001)
    assert color.encode_srgb(linear) == pytest.approx(srgb.cctf_encoding(linear), abs=1e-12)
    np.testing.assert_array_equal(color.REC709_TO_XYZ, srgb.matrix_RGB_to_XYZ)


def test_luminance_is_y():
    assert color.luminance(np.eye(3)) == pytest.approx([0.2126, 0.7152, 0.0722])


def test_delta_e_meets_the_published_pairs():
    """Sharma, Wu, Dalal, The CIEDE2000 Color-Difference Formula, 2005, table 1, pairs 1, 7, 17 and 25."""
    pairs = np.array(
        [
            [[50, 2.6772, -79.7751], [50, 0, -82.7485]],
            [[50, 0, 0], [50, -1, 2]],
            [[50, 2.5, 0], [50, 0, -2.5]],
            [[60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387]],
        ]
    )
    rgb = colour.Lab_to_XYZ(pairs, [0.3127, 0.3290]) @ np.linalg.inv(color.REC709_TO_XYZ).T
    assert color.delta_e(rgb[:, 0], rgb[:, 1]) == pytest.approx([2.0425, 2.3669, 4.3065, 1.2644], abs=1e-4)


def seen(matrix, slope=(0.0, 0.0), glare=0.0):
    """The chart's patches in a camera under sloping light and a white veil."""
    reference = shipped_data.colorchecker().rec709
    return ((1 + POSITION @ np.array(slope))[:, None] * reference + glare) @ matrix.T


def test_matrix_slope_and_glare_of_a_linear_camera_are_recovered():
    fit = color.fit_matrix(seen(0.3 * CAMERA, (0.03, -0.02), 0.015), shipped_data.colorchecker().rec709, POSITION, ALL)
    assert fit.matrix @ (0.3 * CAMERA) == pytest.approx(np.eye(3), abs=1e-9)  # exact algebra in float64
    assert fit.slope == pytest.approx([0.03, -0.02], abs=1e-9)
    assert fit.glare == pytest.approx(0.015, abs=1e-9)
    assert fit.delta_e.max() < 1e-6


def test_matrix_commutes_with_exposure():
    noisy = seen(CAMERA) * np.random.default_rng(1).normal(1, 0.02, (24, 3))
    fits = [color.fit_matrix(k * noisy, shipped_data.colorchecker().rec709, POSITION, ALL) for k in (1, 1000)]
    assert 1000 * fits[1].matrix == pytest.approx(fits[0].matrix, rel=1e-6)
    assert fits[1].delta_e == pytest.approx(fits[0].delta_e, rel=1e-6)


@pytest.mark.parametrize("patch", [0, 8, 15, 19])
def test_a_label_or_a_highlight_on_one_patch_hardly_moves_the_matrix(patch):
    patches = seen(CAMERA) * np.random.default_rng(2).normal(1, 0.005, (24, 3))
    reference = shipped_data.colorchecker().rec709
    clean = color.fit_matrix(patches, reference, POSITION, ALL)
    patches[patch] *= 1.5
    fit = color.fit_matrix(patches, reference, POSITION, ALL)
    assert fit.matrix @ CAMERA == pytest.approx(clean.matrix @ CAMERA, abs=0.02)
    assert fit.delta_e.argmax() == patch


def test_patches_left_out_have_no_say_and_no_residual():
    patches, usable = seen(CAMERA), ALL.copy()
    patches[[18, 19, 15]] = 1.0  # clipped
    usable[[18, 19, 15]] = False
    fit = color.fit_matrix(patches, shipped_data.colorchecker().rec709, POSITION, usable)
    assert fit.matrix @ CAMERA == pytest.approx(np.eye(3), abs=1e-8)
    assert np.array_equal(np.isnan(fit.delta_e), ~usable)


def test_eight_bits_of_srgb_are_those_of_the_curve() -> None:
    linear = np.concatenate([np.linspace(0, 1, 20_001), [-0.5, 1.5, np.nan]])
    exact = 255 * color.encode_srgb(np.clip(np.nan_to_num(linear), 0, 1))
    assert np.abs(color.srgb_eight_bits(linear) - exact).max() <= 0.53


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_report_decodes_srgb_by_the_same_curve() -> None:
    script = (resources.files("polcap") / "formats/html/probe.js").read_text()
    function = re.search(r"^function linear.*?^}", script, re.MULTILINE | re.DOTALL)
    code = f"{function.group()}; console.log(JSON.stringify([...Array(256).keys()].map(linear)))"
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == pytest.approx(color.decode_srgb(np.arange(256) / 255), rel=1e-12)
