"""report.html needs no other file and shows every figure with a label and its unit."""

import re
from html import unescape
from pathlib import Path

import numpy as np

from polcap import report
from polcap.pipeline import run as pipeline
from polcap.report import keys, labels, page
from polcap.results import Results


def test_the_page_opens_with_the_error_that_its_gates_judge(result: Path) -> None:
    about = report.read(result)
    gate = next(gate for gate in about["gates"] if gate["name"] == "normal error")
    assert f"the expected error is below {labels.number(gate['value'])}°." in page.verdict(about)[1]
    gate |= {"value": 31.74, "says": "Expected error of the normals: 31.7° (median), mostly due to: body"}
    assert page.verdict(about)[1].endswith("the expected error is below 31.74°; mostly due to these gates: body.")
    about["gates"].remove(gate)  # as where the shots are out of order
    assert page.verdict(about)[1] == ""


def test_page_needs_no_other_file_and_no_network(result: Path) -> None:
    page = (result / "report.html").read_text()
    assert [found[:40] for found in re.findall(r'(?:src|href)=["\']?(?!["\']|data:|asset/)[^\s>]*', page)] == []
    assert re.findall(r"https?://|@import|url\((?!data:)|fetch\(|XMLHttp", page) == []


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


def test_an_empty_list_is_shown_as_none() -> None:
    assert labels.text("chart.unused", []) == labels.text("chart.unused", {}) == "none"
    assert labels.text("chart.unused", [1, 2]) == "1, 2"


def test_a_report_without_figures_of_the_rerendering_is_drawn(result: Path, tmp_path: Path) -> None:
    about = report.read(result)
    del about["figures"]["rerendering"]
    page.write(tmp_path, about, pipeline.reopen(result, Results)[0])
    assert "45° shot" in (tmp_path / "report.html").read_text()


def test_any_name_is_text_and_no_markup_and_the_link_leads_to_the_asset(result: Path, tmp_path: Path) -> None:
    about = report.read(result)
    about["capture"]["name"] = "<i>jug #3 50% Öl"
    page.write(tmp_path, about, pipeline.reopen(result, Results)[0])
    text = (tmp_path / "report.html").read_text()
    assert "<i>jug" not in text and "&lt;i&gt;jug" in text
    assert 'href="asset/%3Ci%3Ejug%20%233%2050%25%20%C3%96l.glb"' in text
