"""Color profiles are read back complete; foreign ones are refused in one line."""

from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from polcap.chart_values import ColorCalibration, PatchColors
from polcap.errors import ChartError
from polcap.formats import color_profile

PROFILE = ColorCalibration(
    matrix=np.array([[2.1, -0.4, 0.1], [-0.2, 1.5, -0.3], [0.05, -0.6, 1.9]]),
    source="chart",
    cost=0.004,
    metres_per_px=0.00072,
    patches=PatchColors(
        delta_e=np.where(np.arange(24) == 18, np.nan, 1.25),
        use=np.where(np.arange(24) == 18, 1, 0).astype(np.uint8),
        predicted=np.where(np.arange(24) == 18, np.nan, 1.5),
        falloff=(0.01, -0.02),
        glare=0.015,
    ),
)


def test_a_profile_is_read_back_unchanged(tmp_path):
    path = tmp_path / "set-up.toml"
    color_profile.write(path, PROFILE)
    back = color_profile.read(path)
    for part, names in (
        ("", ["matrix", "cost", "metres_per_px"]),
        ("patches.", ["delta_e", "use", "predicted", "falloff", "glare"]),
    ):
        for name in names:
            found, expected = (attrgetter(part + name)(profile) for profile in (back, PROFILE))
            np.testing.assert_allclose(found, expected, atol=1e-8)  # NaN equals NaN
    assert back.source == "chart"


def test_profile_without_a_chart_comes_back_without(tmp_path):
    bare = ColorCalibration(PROFILE.matrix, "camera")
    color_profile.write(tmp_path / "p.toml", bare)
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
