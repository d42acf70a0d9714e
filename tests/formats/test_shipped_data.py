"""Reference colors of charts against the maker's data sheets, and the files that ship with polcap."""

import numpy as np
import pytest

from polcap.errors import StorageError
from polcap.formats import shipped_data
from polcap.optics import color
from polcap.optics.colour_science import colour

D50, D65 = (0.3457, 0.3585), (0.3127, 0.3290)  # xy


@pytest.mark.parametrize(
    ("kind", "dark_skin", "cyan", "white"),
    [
        ("classic", [37.54, 14.37, 14.92], [49.57, -29.71, -28.32], [95.19, -1.03, 2.93]),
        ("classic_before_2014", [37.986, 13.555, 14.059], [51.038, -28.631, -28.638], [96.539, -0.425, 1.186]),
        ("sg", [32.77, 19.91, 22.33], [47.42, -30.91, -32.27], [96.78, -0.66, 2.01]),
    ],
)
def test_chart_has_the_makers_lab_values(kind, dark_skin, cyan, white):
    """The colors, adapted back from D65 to D50, have the CIE Lab values that X-Rite states."""
    found = shipped_data.colorchecker(kind)
    assert found.rec709.shape == (24, 3) and len(found.patches) == 24
    xyz = colour.chromatic_adaptation(
        found.rec709 @ color.REC709_TO_XYZ.T, colour.xy_to_XYZ(D65), colour.xy_to_XYZ(D50), transform="Bradford"
    )
    assert colour.XYZ_to_Lab(xyz, D50)[[0, 17, 18]] == pytest.approx(np.array([dark_skin, cyan, white]), abs=0.01)


def test_white_patch_is_bright_and_nearly_neutral_and_greys_darken():
    grey = shipped_data.colorchecker().rec709[18:]
    assert (np.diff(color.luminance(grey)) < 0).all()
    assert np.ptp(grey, axis=1).max() < 0.06
    assert color.luminance(grey)[0] == pytest.approx(0.8807, abs=0.002)  # Y of the white patch


def test_chart_by_the_makers_srgb_values():
    """Eight-bit triples of the data sheet: white 243 243 242, cyan cut off at 8 133 161."""
    colors = np.rint(255 * color.encode_srgb(shipped_data.colorchecker("classic_srgb").rec709))
    assert colors[[0, 17, 18, 23]].tolist() == [[115, 82, 68], [8, 133, 161], [243, 243, 242], [52, 52, 52]]


def test_the_classic_knows_its_other_editions_and_is_as_wide_as_six_square_patches_by_four():
    found = shipped_data.colorchecker()
    assert len(found.editions) == 2 and len({found.name, *(other.name for other in found.editions)}) == 3
    assert all(other.patches == found.patches and not other.editions for other in found.editions)
    width, height = found.size_m
    assert width / height == pytest.approx((5 + 0.874) / (3 + 0.874), rel=0.01)


def test_data_of_a_checkout_or_of_the_package_is_found_and_missing_data_named(tmp_path, monkeypatch):
    assert shipped_data.data_path("colorchecker/classic_srgb.toml").is_file()
    with pytest.raises(StorageError, match=r"cameras/none\.toml"):
        shipped_data.data_path("cameras/none.toml")
    (tmp_path / "polcap" / "_calib").mkdir(parents=True)
    (tmp_path / "polcap" / "_calib" / "x.toml").write_text("")
    monkeypatch.setattr(shipped_data, "_PACKAGE", tmp_path / "polcap")
    assert shipped_data.data_path("x.toml") == tmp_path / "polcap" / "_calib" / "x.toml"
