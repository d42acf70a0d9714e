"""The report shows every measured figure, and `read` refuses files that are no report."""

import json
import re
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polcap import report
from polcap.errors import StorageError
from polcap.report import compare, keys, labels, map_figures, mesh_preview, page
from tests import surfaces


@pytest.fixture
def figures(result: Path) -> dict[str, Any]:
    return dict(report.read(result)["figures"])


def test_report_is_plain_json_with_figures_gates_and_settings(result: Path) -> None:
    about = json.loads((result / "report.json").read_text(), parse_constant=pytest.fail)  # no NaN, no Infinity
    assert {"capture", "gates", "figures", "settings", "keys", "verdict"} <= about.keys()
    assert about["verdict"] == "pass"
    assert {gate["state"] for gate in about["gates"]} <= {"pass", "not measured"}
    assert len(about["figures"]["chart"]["delta_e"]) == 24


def test_the_page_opens_with_the_error_that_its_checks_judge(result: Path) -> None:
    about = report.read(result)
    gate = next(gate for gate in about["gates"] if gate["name"] == "normal error")
    assert f"half of the normals is below {labels.number(gate['value'])}°." in page.verdict(about)[1]
    gate |= {"value": 31.74, "says": "Expected error of the normals: 31.7° (median), mostly due to: body"}
    assert page.verdict(about)[1].endswith("half of the normals is below 31.74°; mostly due to these checks: body.")
    about["gates"].remove(gate)  # as where the shots are out of order
    assert page.verdict(about)[1] == ""


def test_page_needs_no_other_file_and_no_network(result: Path) -> None:
    page = (result / "report.html").read_text()
    assert [found[:40] for found in re.findall(r'(?:src|href)=["\']?(?!["\']|data:|asset/)[^\s>]*', page)] == []
    assert re.findall(r"https?://|@import|url\(|fetch\(|XMLHttp", page) == []


def test_page_shows_every_figure_with_words_and_unit(result: Path) -> None:
    page = unescape((result / "report.html").read_text())
    about = report.read(result)
    for part, values in about["figures"].items():
        for name, value in values.items():
            assert f"{part}.{name}" in labels.LABELS, f"{part}.{name} has no words of its own"
            assert f"<td>{labels.text(f'{part}.{name}', value)}</td>" in page
    assert not re.search(r"<td>(?:\[|\{|None|True|False|nan)", page)


def test_agreement_is_drawn_gray_and_registration_has_a_caption(result: Path) -> None:
    middle = keys.colors(keys.DIFFERENCE.palette)[keys.LEVELS // 2]
    assert np.ptp(middle) < 3 and 100 < middle.mean() < 180  # neither black, which is no object, nor white
    page = unescape((result / "report.html").read_text())
    assert re.search(r"<b>45° shot moved by [+-][.\d]+, [+-][.\d]+ ± [.\d]+ px</b>", page)


def test_photographs_and_their_rerendering_agree(result: Path) -> None:
    found = report.read(result)["figures"]["rerendering"]
    assert len(found["rms"]) == 3 and max(found["rms"]) < 0.15 and 0.5 < found["scale"] < 2


def test_comparison_names_figures_and_settings_that_differ(result: Path) -> None:
    one = report.read(result)
    other = json.loads(json.dumps(one))
    other["figures"]["maps"]["estimator"] = "network"
    other["settings"]["hdr"]["clip"] = 0.9
    rows = {name: (here, there) for name, here, there in compare.rows(one, other)}
    assert rows["figures.maps.estimator"] == ("analytic", "network")
    assert set(rows) == {"figures.maps.estimator", "settings.hdr.clip"}
    assert compare.rows(one, one) == []


def test_comparison_is_a_page_like_the_report(result: Path, tmp_path: Path) -> None:
    about = report.read(result)
    changed = json.loads(json.dumps(about))
    changed["figures"]["maps"]["roughness_median"] = 0.5
    compare.write(tmp_path / "compare.html", (result, result), (about, changed))
    page = unescape((tmp_path / "compare.html").read_text())
    assert "<td>Maps: Median roughness</td>" in page and "<td>0.5</td>" in page
    assert page.count('class="map"') == 11 and "median 0°" in page


def test_mesh_of_a_page_has_few_vertices_where_the_surface_is() -> None:
    mesh = surfaces.mesh(surfaces.maps())
    vertices, uv, faces = mesh_preview.thinned(mesh, 600)
    assert 200 < len(vertices) <= 900 and faces.max() < len(vertices) and len(uv) == len(vertices)
    radius = np.linalg.norm(vertices - mesh.vertices.mean(0), axis=1)
    assert radius.max() <= np.linalg.norm(mesh.vertices - mesh.vertices.mean(0), axis=1).max()
    along, across = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    normals = np.cross(along, across)
    assert (normals[:, 2] > 0).mean() > 0.99  # still seen from the camera


@pytest.mark.parametrize("text", [None, "{", "[]", "{}"])
def test_missing_or_foreign_report_is_one_line(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "report.json").write_text(text)
    with pytest.raises(StorageError, match="polcap process"):
        report.read(tmp_path)


def test_a_folder_that_is_no_result_is_named_with_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="no such folder"):
        report.read(tmp_path / "elsewhere")
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "maps").mkdir()
    with pytest.raises(StorageError, match=f"only a part of a result; give the whole, {tmp_path}"):
        report.read(tmp_path / "maps")


@pytest.mark.parametrize(
    "left_out", ["verdict", "gates", "keys", "model", "figures.maps", "gates.0.state", "gates.0.says"]
)
def test_a_report_of_another_polcap_is_one_line(result: Path, tmp_path: Path, left_out: str) -> None:
    about = json.loads((result / "report.json").read_text("utf-8"))
    *outer, last = left_out.split(".")
    place = about
    for name in outer:
        place = place[int(name) if name.isdecimal() else name]
    del place[last]
    (tmp_path / "report.json").write_text(json.dumps(about), "utf-8")
    with pytest.raises(StorageError, match=rf"report\.json is no report of this polcap \(.*{last}.*\); run"):
        report.read(tmp_path)


@pytest.mark.parametrize(
    "strange", [{"state": "splendid"}, {"value": []}, {"name": None}, {"cost_deg": "much"}, {"unit": "ell"}]
)
def test_a_report_of_strange_gates_is_one_line(result: Path, tmp_path: Path, strange: dict[str, Any]) -> None:
    about = json.loads((result / "report.json").read_text("utf-8"))
    about["gates"][0] |= strange
    (tmp_path / "report.json").write_text(json.dumps(about), "utf-8")
    with pytest.raises(StorageError, match=r"\$\.gates\[0\]"):
        report.read(tmp_path)


def test_an_empty_list_is_shown_as_none() -> None:
    assert labels.text("chart.unused", []) == "none"
    assert labels.text("chart.unused", [1, 2]) == "1, 2"


def test_an_object_too_thin_for_the_page_leaves_its_figures_out() -> None:
    nothing = np.zeros((4, 5))
    small: Any = SimpleNamespace(angle=np.zeros(1), maps=SimpleNamespace(mask=nothing > 0))  # all that is read of it
    again: Any = SimpleNamespace(measured=[nothing], predicted=[nothing])
    section = "".join(map_figures.rerendered(small, again, {"figures": {"rerendering": {"rms": [None]}}}))
    assert "Polarizer at 0°" in section and "rms" not in section
