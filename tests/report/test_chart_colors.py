"""Colors of the chart as a laboratory states them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap import report
from polcap.pipeline import run as pipeline
from polcap.report import chart_colors
from polcap.results import Results


def test_the_three_differences_make_up_the_difference_of_lab() -> None:
    """ΔE*ab² = ΔL*² + ΔC*² + ΔH*², and ΔH* is positive for a turn of the hue counter-clockwise."""
    random = np.random.default_rng(0)
    one, other = random.uniform([20, -60, -60], [90, 60, 60], (2, 50, 3))
    parts = chart_colors._differences(one, other)
    assert np.sum(np.square(parts), axis=0) == pytest.approx(np.sum((one - other) ** 2, axis=1), rel=1e-9)
    _, _, turned = chart_colors._differences(np.array([[50.0, 9, 3]]), np.array([[50.0, 9, -3]]))
    assert turned[0] > 0


def test_report_json_has_a_row_per_patch_with_published_lab(result: Path) -> None:
    """L* of the gray patches of a Classic since 2014 (X-Rite); grays keep it under another light."""
    rows = report.read(result)["patches"]
    assert len(rows) == 24 and rows[0]["name"] == "dark skin"
    lightness = [row["lab_reference"][0] for row in rows[18:]]
    assert lightness == pytest.approx([95.19, 81.29, 66.89, 50.76, 35.63, 20.64], abs=0.05)
    for row in rows:
        assert row["lab"][0] - row["lab_reference"][0] == pytest.approx(row["delta_l"], abs=0.02)


def test_a_patch_that_was_not_measured_has_no_numbers(result: Path) -> None:
    results, facts = pipeline.reopen(result, Results)
    fit = results.color.patches
    assert fit is not None
    color = replace(results.color, patches=replace(fit, delta_e=np.full(24, np.nan)))
    rows = chart_colors.patches(results.radiance, color, facts["settings"]["whitebalance"]["chart"])
    assert {row["delta_e"] for row in rows} == {None} and json.dumps(rows, allow_nan=False)


def test_a_file_of_measurements_has_a_digest_and_the_makers_values_have_none(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("L,a,b")
    assert re.fullmatch("[0-9a-f]{64}", chart_colors.digest(str(tmp_path / "mine.csv")) or "")
    assert chart_colors.digest("classic") is None
