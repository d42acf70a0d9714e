"""The report tells what was measured, and its gates mean what they say."""

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap import report
from polcap.config import Gates
from polcap.errors import StorageError
from polcap.report import compare, labels, lean
from tests import surfaces


@pytest.fixture
def figures(result: Path) -> dict[str, Any]:
    return dict(report.read(result)["figures"])


def test_report_is_plain_json_with_figures_gates_and_settings(result: Path) -> None:
    about = json.loads((result / "report.json").read_text(), parse_constant=pytest.fail)  # no NaN, no Infinity
    assert {"capture", "gates", "figures", "settings", "keys", "verdict"} <= about.keys()
    assert about["verdict"] == "pass" and all(gate["state"] == "pass" for gate in about["gates"])
    assert len(about["figures"]["chart"]["delta_e"]) == 24


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


def test_photographs_and_their_rerendering_agree(result: Path) -> None:
    found = report.read(result)["figures"]["rerendering"]
    assert len(found["rms"]) == 3 and max(found["rms"]) < 0.15 and 0.5 < found["scale"] < 2


@pytest.mark.parametrize(
    ("part", "name", "value", "gate"),
    [
        ("chart", "delta_e_mean", 5.5, "chart"),
        ("gains", "disagreement", 0.011, "gains"),
        ("alignment", "residual_px", [0.0, 0.02, 0.2], "alignment"),
        ("object", "clipped_fraction", 0.03, "clipped"),
        ("object", "ill_posed_fraction", 0.06, "ill-posed"),
        ("object", "mask_doubt", 0.11, "mask"),
        ("merge", "ghost_fraction", [0.0, 0.05, 0.0], "ghosts"),
        ("angles", "best_order", [1, 0, 2], "angles"),
        ("angles", "mirrored", True, "angles"),
        ("maps", "normal_error_deg_median", 25.0, "normal error"),
    ],
)
def test_gate_fails_beyond_its_limit_and_alone(
    figures: dict[str, Any], part: str, name: str, value: Any, gate: str
) -> None:
    assert name in figures[part]
    changed = {**figures, part: {**figures[part], name: value}}
    states = {one.name: one.state for one in report.judge(changed, True, Gates())}
    assert [name for name, state in states.items() if state == "fail"] == [gate]
    assert report.verdict(report.judge(changed, True, Gates())) == "fail"


def test_what_could_not_be_measured_neither_passes_nor_fails(figures: dict[str, Any]) -> None:
    changed = {**figures, "chart": {**figures["chart"], "delta_e_mean": None}}
    states = {gate.name: gate.state for gate in report.judge(changed, True, Gates())}
    assert states["chart"] == "not measured"


@pytest.mark.parametrize(("name", "value"), [("mask_border", 0.01), ("mask_islands", 0.03), ("mask_holes", 0.06)])
def test_a_mask_of_a_doubtful_shape_warns_and_says_mask(figures: dict[str, Any], name: str, value: float) -> None:
    sure = {**figures["object"], "mask_doubt": 0.01, name: value}
    gate = next(g for g in report.judge({**figures, "object": sure}, True, Gates()) if g.name == "mask")
    assert gate.state == "warn" and "--mask" in gate.says


def test_assumed_focal_length_warns_and_does_not_fail(figures: dict[str, Any]) -> None:
    gates = report.judge(figures, False, Gates())
    assert report.verdict(gates) == "warn"


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
    vertices, uv, faces = lean.thinned(mesh, 600)
    assert 200 < len(vertices) <= 900 and faces.max() < len(vertices) and len(uv) == len(vertices)
    radius = np.linalg.norm(vertices - mesh.vertices.mean(0), axis=1)
    assert radius.max() <= np.linalg.norm(mesh.vertices - mesh.vertices.mean(0), axis=1).max()
    normals = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    assert (normals[:, 2] > 0).mean() > 0.99  # still seen from the camera


@pytest.mark.parametrize("text", [None, "{", "[]", "{}"])
def test_missing_or_foreign_report_is_one_line(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "report.json").write_text(text)
    with pytest.raises(StorageError, match="polcap process"):
        report.read(tmp_path)
