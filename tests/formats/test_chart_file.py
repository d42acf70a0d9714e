"""Measured charts: CSV and CGATS with Lab, XYZ or spectra are the colors that they state."""

from pathlib import Path

import numpy as np
import pytest

from polcap import config
from polcap.errors import ChartError, SettingError
from polcap.formats import chart_file, shipped_data
from polcap.optics import color
from polcap.optics.colour_science import colour

D50, D65 = (0.3457, 0.3585), (0.3127, 0.3290)  # xy
BY_COLUMN = [f"{column}{row}" for row in range(1, 5) for column in "ABCDEF"]


def lab() -> np.ndarray:
    """CIE Lab (24, 3) of the Classic under D50, from dark skin."""
    xyz = shipped_data.colorchecker().rec709 @ color.REC709_TO_XYZ.T
    adapted = colour.chromatic_adaptation(xyz, colour.xy_to_XYZ(D65), colour.xy_to_XYZ(D50), transform="Bradford")
    return np.asarray(colour.XYZ_to_Lab(adapted, D50))


def xyz_percent() -> np.ndarray:
    """XYZ (24, 3) of the Classic under D50, white Y = 100."""
    return np.asarray(100 * colour.Lab_to_XYZ(lab(), D50))


def rows(names: list[str], values: np.ndarray, between: str) -> list[str]:
    return [between.join([name, *(f"{value:.6f}" for value in row)]) for name, row in zip(names, values)]


def cgats(fields: str, listed: list[str]) -> str:
    head = ["CTI3", 'DESCRIPTOR "x"', "BEGIN_DATA_FORMAT", fields, "END_DATA_FORMAT"]
    return "\n".join([*head, "BEGIN_DATA", *listed, "END_DATA", ""])


FILES = {
    "lab.csv": lambda: "\n".join(["Patch,L*,a*,b*", *rows(BY_COLUMN, lab(), ",")]),
    "no_names.csv": lambda: "\n".join(["L,a,b", *(row[1:] for row in rows([""] * 24, lab(), ","))]),
    "german.csv": lambda: "\n".join(
        ["Feld;X;Y;Z", *[r.replace(".", ",") for r in rows(BY_COLUMN, xyz_percent(), ";")]]
    ),
    "out_of_order.csv": lambda: "\n".join(["id,X,Y,Z", *rows(BY_COLUMN, xyz_percent(), ",")[::-1]]),
    "chart.ti3": lambda: cgats("SAMPLE_ID XYZ_X XYZ_Y XYZ_Z", rows([f'"{n}"' for n in BY_COLUMN], xyz_percent(), " ")),
    "chart.txt": lambda: cgats("SAMPLE_NAME LAB_L LAB_A LAB_B", rows(BY_COLUMN, lab(), "\t")),
}


@pytest.mark.parametrize("name", FILES)
def test_a_measured_chart_has_the_stated_colors(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FILES[name](), encoding="utf-8-sig")
    found = chart_file.read(tmp_path / name)
    np.testing.assert_allclose(found.rec709, shipped_data.colorchecker().rec709, atol=1e-5)
    assert name in found.name and not found.is_block and len(found.patches) == 24


@pytest.mark.parametrize("percent", [False, True])
def test_measured_spectra_are_seen_under_d65(tmp_path: Path, percent: bool) -> None:
    """Measured spectra of a Classic (Ohta) against the average Lab of thirty charts (BabelColor): about 1 ΔE."""
    spectra = [
        sd.copy().align(colour.SpectralShape(380, 780, 10))
        for sd in colour.SDS_COLOURCHECKERS["ColorChecker N Ohta"].values()
    ]
    values = np.array([sd.values for sd in spectra]) * (100 if percent else 1)
    head = ",".join(["id", *(f"SPEC_{band}" for band in range(380, 781, 10))])
    (tmp_path / "spectra.csv").write_text("\n".join([head, *rows(BY_COLUMN, values, ",")]))
    found = chart_file.read(tmp_path / "spectra.csv").rec709
    known = shipped_data.colorchecker("classic_before_2014").rec709
    errors = colour.delta_E(*(colour.XYZ_to_Lab(one @ color.REC709_TO_XYZ.T, D65) for one in (found, known)))
    assert errors.mean() < 1.5 and errors.max() < 4


def test_of_a_measured_sg_the_block_and_all_others_are_used(tmp_path: Path) -> None:
    table = colour.CCS_COLOURCHECKERS["ColorCheckerSG - After November 2014"]
    xyz = np.asarray(colour.xyY_to_XYZ(list(table.data.values())))
    (tmp_path / "sg.csv").write_text("\n".join(["id,X,Y,Z", *rows(list(table.data), xyz, ",")]))
    found, shipped = shipped_data.colorchecker(str(tmp_path / "sg.csv")), shipped_data.colorchecker("sg")
    np.testing.assert_allclose(found.rec709, shipped.rec709, atol=1e-3)
    assert found.is_block and found.patches == chart_file.SG_BLOCK
    assert found.surroundings is not None and shipped.surroundings is not None
    np.testing.assert_allclose(found.surroundings.rec709, shipped.surroundings.rec709, atol=1e-3)
    of_block = [
        row for row in (tmp_path / "sg.csv").read_text().splitlines() if row.split(",")[0] in chart_file.SG_BLOCK
    ]
    (tmp_path / "block.csv").write_text("\n".join(["id,X,Y,Z", *of_block]))
    alone = chart_file.read(tmp_path / "block.csv")
    np.testing.assert_allclose(alone.rec709, found.rec709)
    assert alone.is_block and alone.surroundings is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no columns"),
        ("id,R,G,B\nA1,1,2,3\n", "no columns L, a, b or X, Y, Z"),
        ("L,a,b\n1,2,3\n", "1 patches without names; a Classic has 24"),
        ("L,a,b\n1,2\n", "row 1 has 2 values for 3 columns"),
        ("L,a,b\n1,2,dark\n", "dark"),
        ("BEGIN_DATA\n1\n", "no table between BEGIN_DATA and END_DATA"),
    ],
)
def test_a_faulty_chart_file_is_one_clear_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "chart.csv").write_text(text)
    with pytest.raises(ChartError, match=words) as caught:
        chart_file.read(tmp_path / "chart.csv")
    assert "whitebalance.chart = " in str(caught.value) and "\n" not in str(caught.value)


def test_the_setting_takes_a_kind_or_a_file() -> None:
    assert config.load(None, ["whitebalance.chart=my chart.ti3"]).whitebalance.chart == "my chart.ti3"
    with pytest.raises(ChartError, match=r"none\.csv: cannot be read"):
        shipped_data.colorchecker("none.csv")
    with pytest.raises(SettingError, match=r"whitebalance.chart = 'sgg': no such choice \(classic, "):
        config.load(None, ["whitebalance.chart=sgg"])
