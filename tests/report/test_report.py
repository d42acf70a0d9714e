"""report.json holds figures, gates and settings, and files that are no report are refused in one line."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap import report
from polcap.errors import StorageError
from polcap.formats.maps import maps_folder
from polcap.pipeline import clean_cache, run_facts
from polcap.quality.rerendering import Rerendering
from polcap.report import page


def test_report_is_plain_json_with_figures_gates_and_settings(result: Path) -> None:
    about = json.loads((result / "report.json").read_text(), parse_constant=pytest.fail)  # no NaN, no Infinity
    assert {"capture", "gates", "figures", "settings", "keys", "verdict"} <= about.keys()
    assert about["verdict"] == "pass"
    assert {gate["state"] for gate in about["gates"]} <= {"pass", "not measured"}
    assert len(about["figures"]["chart"]["delta_e"]) == 24


def test_the_stated_error_is_the_median_of_the_stored_map(result: Path) -> None:
    maps, about = maps_folder.read(result / "maps"), report.read(result)
    median = float(np.median(maps.confidence[maps.mask]))
    assert about["expected_error_deg"] == pytest.approx(median, rel=2e-3)  # half floats
    assert about["figures"]["maps"]["normal_error_deg_median"] == pytest.approx(median, rel=2e-3)


def test_photographs_and_their_rerendering_agree(result: Path) -> None:
    found = report.read(result)["figures"]["rerendering"]
    assert len(found["rms"]) == 3 and max(found["rms"]) < 0.15 and 0.5 < found["scale"] < 2


def test_a_few_pixels_do_not_carry_the_residual_of_the_rerendering(rng: np.random.Generator) -> None:
    """23 of 53,000 pixels of a highlight once made an rms of 813 % of noise of 3 %."""
    predicted = np.zeros((2, 53_000, 1))
    measured = rng.normal(0, 0.03, predicted.shape)
    measured[1, :23] = 390
    found = Rerendering(measured, predicted, np.zeros((53_000, 1, 3)), 1.0).residuals(np.ones((53_000, 1), bool))
    assert found["rms"] == pytest.approx([0.03, 0.03], rel=0.02)
    assert found["outliers"] == pytest.approx([0, 23 / 53_000], abs=2e-5)


@pytest.mark.parametrize(
    ("difference", "highlights", "words"),
    [
        (0.06, 1.1, "Both pictures agree, within 6 %"),
        (0.06, 2.5, "2.5 times brighter, so the object is glossier"),
        (0.06, 0.4, "2.5 times darker, so the object is duller"),
        (0.4, 1.0, "Both differ by 40 %"),
    ],
)
def test_photograph_and_rerendering_agree_only_where_the_page_says_so(
    difference: float, highlights: float, words: str
) -> None:
    none = np.zeros((1, 1, 1))
    rendered = Rerendering(none, none, np.zeros((1, 1, 3)), 1.0, difference=difference, highlights=highlights)
    said = page.light_agreement(rendered)
    assert words in said and ("agree" in said) is (words.startswith("Both pictures agree"))


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


def test_folders_of_captures_in_place_of_a_result_are_named_with_what_to_run(tmp_path: Path) -> None:
    for angle in ("pol000", "pol045", "pol090"):
        (tmp_path / "session" / "mug" / angle).mkdir(parents=True)
        (tmp_path / "object" / "view01" / angle).mkdir(parents=True)
    capture = tmp_path / "session" / "mug"
    words = {
        capture: "is a capture without a result; run `polcap process` on it first",
        capture / "pol045": f"holds one angle of a capture; give the folder of all, {capture}",
        tmp_path
        / "session": "holds captures without results: mug; run `polcap process` on one of them, or `polcap batch`",
        tmp_path / "object": "holds the views view01 of one object; join them with `polcap fuse`",
        tmp_path: "holds no result; give the result folder of `polcap process`",
    }
    for folder, text in words.items():
        with pytest.raises(StorageError, match=re.escape(f"{folder} {text}")):
            report.read(folder)
        assert f"{folder} {text}" in str(run_facts.no_cache(folder))
        with pytest.raises(StorageError, match=re.escape(f"{folder} {text}")):
            clean_cache.clean(folder)
    (capture / "polcap" / "maps").mkdir(parents=True)
    (capture / "polcap" / "asset" / "unreal").mkdir(parents=True)
    (capture / "polcap" / "report.json").write_text("{}")
    with pytest.raises(StorageError, match=r"session holds no result itself; give that of a sub-folder: mug$"):
        report.read(tmp_path / "session")
    with pytest.raises(StorageError, match=f"only a part of a result; give the whole, {capture / 'polcap'}$"):
        report.read(capture / "polcap" / "asset" / "unreal")


@pytest.mark.parametrize("left_out", ["verdict", "gates", "keys", "model", "figures", "gates.0.state", "gates.0.says"])
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
