"""A comparison lists exactly the figures and settings that differ."""

import json
from html import unescape
from pathlib import Path

from polcap import report
from polcap.report import compare


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
