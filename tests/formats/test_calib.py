"""Reference colours of charts against the maker's data sheets, and profiles that come back as they went."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from polcap.errors import ChartError, StorageError
from polcap.formats import calib
from polcap.images import ColorCalibration
from polcap.optics import color
from polcap.optics.colour_science import colour

D50, D65 = (0.3457, 0.3585), (0.3127, 0.3290)  # xy
PROFILE = ColorCalibration(
    matrix=np.array([[2.1, -0.4, 0.1], [-0.2, 1.5, -0.3], [0.05, -0.6, 1.9]]),
    quads=np.arange(192.0).reshape(24, 4, 2),
    corners=np.array([[1.0, 2], [30, 2], [30, 22], [1, 22]]),
    delta_e=np.where(np.arange(24) == 18, np.nan, 1.25),
    source="chart",
    cost=0.004,
    metres_per_px=0.00072,
    falloff=(0.01, -0.02),
    glare=0.015,
    predicted=np.where(np.arange(24) == 18, np.nan, 1.5),
    patch_use=np.where(np.arange(24) == 18, 1, 0).astype(np.uint8),
)


@pytest.mark.parametrize(
    ("kind", "dark_skin", "cyan", "white"),
    [
        ("classic", [37.54, 14.37, 14.92], [49.57, -29.71, -28.32], [95.19, -1.03, 2.93]),
        ("classic_before_2014", [37.986, 13.555, 14.059], [51.038, -28.631, -28.638], [96.539, -0.425, 1.186]),
        ("sg", [32.77, 19.91, 22.33], [47.42, -30.91, -32.27], [96.78, -0.66, 2.01]),
    ],
)
def test_chart_has_the_makers_lab_values(kind, dark_skin, cyan, white):
    """X-Rite states CIE Lab under D50: those are found again when the colors are adapted back from D65."""
    found = calib.colorchecker(kind)
    assert found.rec709.shape == (24, 3) and len(found.patches) == 24
    xyz = colour.chromatic_adaptation(
        found.rec709 @ color.REC709_TO_XYZ.T, colour.xy_to_XYZ(D65), colour.xy_to_XYZ(D50), transform="Bradford"
    )
    assert colour.XYZ_to_Lab(xyz, D50)[[0, 17, 18]] == pytest.approx(np.array([dark_skin, cyan, white]), abs=0.01)


def test_white_patch_is_bright_and_nearly_neutral_and_greys_darken():
    grey = calib.colorchecker().rec709[18:]
    assert (np.diff(color.luminance(grey)) < 0).all()
    assert np.ptp(grey, axis=1).max() < 0.06
    assert color.luminance(grey)[0] == pytest.approx(0.8807, abs=0.002)  # Y of the white patch


def test_chart_by_the_makers_srgb_values():
    """Eight-bit triples of the data sheet: white 243 243 242, cyan cut off at 8 133 161."""
    colors = np.rint(255 * color.encode_srgb(calib.colorchecker("classic_srgb").rec709))
    assert colors[[0, 17, 18, 23]].tolist() == [[115, 82, 68], [8, 133, 161], [243, 243, 242], [52, 52, 52]]


def test_the_classic_knows_its_other_editions():
    found = calib.colorchecker()
    assert len(found.editions) == 2 and len({found.name, *(other.name for other in found.editions)}) == 3
    assert all(other.patches == found.patches and not other.editions for other in found.editions)


def test_chart_is_as_wide_as_six_square_patches_by_four():
    width, height = calib.colorchecker().size_m
    assert width / height == pytest.approx((5 + 0.874) / (3 + 0.874), rel=0.01)


def test_data_of_a_checkout_is_found_and_missing_data_named():
    assert calib.data_path("colorchecker/classic_srgb.toml").is_file()
    with pytest.raises(StorageError, match=r"cameras/none\.toml"):
        calib.data_path("cameras/none.toml")


def test_installed_data_is_found_in_the_package(tmp_path, monkeypatch):
    (tmp_path / "polcap" / "_calib").mkdir(parents=True)
    (tmp_path / "polcap" / "_calib" / "x.toml").write_text("")
    monkeypatch.setattr(calib, "_PACKAGE", tmp_path / "polcap")
    assert calib.data_path("x.toml") == tmp_path / "polcap" / "_calib" / "x.toml"


def test_profile_comes_back_as_it_went(tmp_path):
    path = tmp_path / "set-up.toml"
    calib.write_profile(path, PROFILE)
    back = calib.read_profile(path)
    for name in (
        "matrix",
        "quads",
        "corners",
        "delta_e",
        "cost",
        "metres_per_px",
        "falloff",
        "glare",
        "predicted",
        "patch_use",
    ):
        np.testing.assert_allclose(getattr(back, name), getattr(PROFILE, name), atol=1e-8)  # NaN equals NaN
    assert back.source == "chart"


def test_profile_without_a_chart_comes_back_without(tmp_path):
    bare = dataclasses.replace(PROFILE, quads=None, corners=None, delta_e=None, metres_per_px=None, source="camera")
    calib.write_profile(tmp_path / "p.toml", bare)
    back = calib.read_profile(tmp_path / "p.toml")
    assert (back.quads, back.corners, back.delta_e, back.metres_per_px) == (None, None, None, None)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("matrix = 3", "not a polcap colour file"),
        ("\x00\x01", "not a polcap colour file"),
        ('source = "chart"\nmatrix = [[1.0,0,0],[0,1,0],[1,1,0]]', "cannot be inverted"),
        ('source = "magic"\nmatrix = [[1.0,0,0],[0,1,0],[0,0,1]]', "magic"),
        ('source = "chart"\nmatrix = [[1.0,0,0],[0,1,0],[0,0,1]]\ndelta_e = [1.0]', "delta_e"),
        ('source = "chart"\nmatrix = [[1.0,0,0],[0,1,0],[0,0,1]]\ncorners = [[1.0], [1.0, 2.0]]', "corners"),
    ],
)
def test_foreign_profile_is_one_clear_line(tmp_path: Path, text: str, says: str):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(ChartError, match=says) as error:
        calib.read_profile(path)
    assert str(path) in str(error.value)


def test_missing_profile_is_one_clear_line(tmp_path):
    with pytest.raises(ChartError, match="nowhere"):
        calib.read_profile(tmp_path / "nowhere.toml")
