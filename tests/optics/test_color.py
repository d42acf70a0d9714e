"""Color against the standard's own numbers and published color-difference pairs."""

import json
import re
import shutil
import subprocess
from importlib import resources

import numpy as np
import pytest

from polcap.optics import color
from polcap.optics.colour_science import colour


def test_srgb_curve_is_inverted_negative_values_too():
    linear = np.linspace(-0.5, 4, 1001)
    assert color.decode_srgb(color.encode_srgb(linear)) == pytest.approx(linear, rel=1e-4, abs=2e-7)


def test_srgb_curve_serves_torch():
    torch = pytest.importorskip("torch")
    value = torch.tensor([-0.2, 0.0, 0.002, 0.4, 1.0], dtype=torch.float64)
    assert color.encode_srgb(value).numpy() == pytest.approx(color.encode_srgb(value.numpy()))


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
