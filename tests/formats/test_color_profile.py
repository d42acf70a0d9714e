"""Color profiles are read back complete; foreign ones are refused in one line."""

from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from polcap.chart_values import ColorCalibration, PatchColors
from polcap.errors import ChartError
from polcap.formats import color_profile

MATRIX = np.array([[2.1, -0.4, 0.1], [-0.2, 1.5, -0.3], [0.05, -0.6, 1.9]])
LEFT_OUT = np.arange(24) == 18
PATCHES = PatchColors(
    np.where(LEFT_OUT, np.nan, 1.25), LEFT_OUT.astype(np.uint8), np.where(LEFT_OUT, np.nan, 1.5), (0.01, -0.02), 0.015
)
PROFILE = ColorCalibration(MATRIX, "chart", cost=0.004, metres_per_px=0.00072, patches=PATCHES)


def test_a_profile_is_read_back_unchanged(tmp_path):
    path = tmp_path / "set-up.toml"
    color_profile.write(path, PROFILE)
    back = color_profile.read(path)
    patches = [f"patches.{name}" for name in ("delta_e", "use", "predicted", "falloff", "glare")]
    for name in ("matrix", "cost", "metres_per_px", *patches):
        np.testing.assert_allclose(attrgetter(name)(back), attrgetter(name)(PROFILE), atol=1e-8)  # NaN equals NaN
    assert back.source == "chart"


def test_profile_without_a_chart_comes_back_without(tmp_path):
    color_profile.write(tmp_path / "p.toml", ColorCalibration(MATRIX, "camera"))
    back = color_profile.read(tmp_path / "p.toml")
    assert (back.patches, back.metres_per_px) == (None, None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("matrix = 3", "not a polcap color profile"),
        ("\x00\x01", "not a polcap color profile"),
        ('source = "chart"\nmatrix = [[1.0,0,0],[0,1,0],[1,1,0]]', "cannot be inverted"),
        ('source = "magic"\nmatrix = [[1.0,0,0],[0,1,0],[0,0,1]]', "magic"),
        ('source = "chart"\nmatrix = [[1.0,0,0],[0,1,0],[0,0,1]]\ndelta_e = [1.0]', "delta_e"),
    ],
)
def test_foreign_profile_is_one_clear_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(ChartError, match=message) as error:
        color_profile.read(path)
    assert str(path) in str(error.value)


def test_missing_profile_is_one_clear_line(tmp_path):
    with pytest.raises(ChartError, match="nowhere"):
        color_profile.read(tmp_path / "nowhere.toml")
