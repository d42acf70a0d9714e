"""A run that has nothing to do is recognized by sizes and times of all files, and by nothing less."""

import os
import shutil
from pathlib import Path

import pytest

from polcap.formats import own_files
from polcap.pipeline import unchanged
from tests.conftest import TINY, Command, python

OLD_NS = 1_000_000_000 * 10**9
ASKED = {"angles": None}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A folder with one settled file."""
    folder = tmp_path / "capture"
    folder.mkdir()
    _settled(folder / "a.dng", "a")
    return folder


def _settled(file: Path, text: str, age: int = 0) -> None:
    file.write_text(text)
    os.utime(file, ns=(OLD_NS + age, OLD_NS + age))


def test_same_request_has_the_same_digest_and_any_other_has_not(capture: Path) -> None:
    out = capture / "polcap"
    first = unchanged.request(ASKED, capture, out, ())
    assert first is not None and first == unchanged.request(ASKED, capture, out, ())
    out.mkdir()
    (out / "maps").write_text("the result is no photograph")
    (capture / "polcap-batch").mkdir()
    (capture / "polcap-batch" / "summary.html").write_text("nor is the record of a batch")
    assert first == unchanged.request(ASKED, capture, out, ())
    assert first != unchanged.request({"angles": "0,45,90"}, capture, out, ())
    assert first != unchanged.request(ASKED, capture, out.with_name("other"), ())
    assert first != unchanged.request(ASKED, capture, out, [capture / "a.dng"])
    _settled(capture / "b.dng", "b")
    added = unchanged.request(ASKED, capture, out, ())
    _settled(capture / "b.dng", "c", 1)  # as large as before
    assert len({first, added, unchanged.request(ASKED, capture, out, ())}) == 3


def test_content_that_changed_under_its_old_time_is_seen(capture: Path) -> None:
    """Whoever sets a file's time back cannot set back when he did so."""
    before = unchanged.request(ASKED, capture, capture / "polcap", ())
    _settled(capture / "new", "b")
    os.replace(capture / "new", capture / "a.dng")
    assert before != unchanged.request(ASKED, capture, capture / "polcap", ())


def test_a_file_that_only_the_settings_name_is_watched(capture: Path) -> None:
    """Such as the measured colors of the chart, which are known once the settings are read."""
    out, colors = capture / "polcap", capture.parent / "chart.ti3"
    (out / "work").mkdir(parents=True)
    (out / "report.json").write_text("{}")
    own_files.claim(out, [])
    _settled(colors, "a")
    unchanged.remember(out, "asked", files=[colors])
    assert unchanged.find(out, "asked") is not None
    _settled(colors, "b", 1)
    assert unchanged.find(out, "asked") is None


def test_what_has_just_changed_is_in_doubt(capture: Path) -> None:
    (capture / "a.dng").write_text("b")
    assert unchanged.request(ASKED, capture, capture / "polcap", ()) is None
    assert unchanged.find(capture / "polcap", None) is None


def test_folder_behind_a_link_is_in_doubt(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (capture / "pol000").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    assert unchanged.request(ASKED, capture, capture / "polcap", ()) is None


def test_result_that_was_touched_is_no_answer(capture: Path) -> None:
    out = capture / "polcap"
    (out / "work").mkdir(parents=True)
    (out / "report.json").write_text('{"verdict": "pass"}')
    unchanged.remember(out, "asked", "table")
    assert unchanged.find(out, "other") is None
    found = unchanged.find(out, "asked")
    assert found == unchanged.Finished("table", {"verdict": "pass"})
    os.utime(out / "report.json", ns=(OLD_NS, OLD_NS))
    assert unchanged.find(out, "asked") is None


def test_files_that_a_run_does_not_write_do_not_matter(capture: Path) -> None:
    out = capture / "polcap"
    (out / "work").mkdir(parents=True)
    (out / "asset").mkdir()
    (out / "report.json").write_text("{}")
    unchanged.remember(out, "asked")
    for name in ("work/hdr.png", "compare.html", "asset/mine.blend"):
        (out / name).write_text("of `show`, of `report --compare`, of the user")
    assert unchanged.find(out, "asked") is not None


def test_an_export_and_another_report_leave_a_result_up_to_date(tiny_result: Path, polcap: Command) -> None:
    copy = tiny_result
    unchanged.remember(copy, "asked")
    for first, *words in (["export", "--gltf", "--lod", "1"], ["report"], ["show", "mask"]):
        assert polcap(first, copy, *words).returncode in (0, 3)
        assert unchanged.find(copy, "asked") is not None
    (copy / "report.html").write_text("of the user")
    assert polcap("export", copy).returncode == 0
    assert unchanged.find(copy, "asked") is None


def test_run_with_nothing_to_do_loads_no_library(
    tiny: Path, tiny_result: Path, polcap: Command, tmp_path: Path
) -> None:
    capture = tmp_path / "C"
    shutil.copytree(tiny / "C", capture, ignore=shutil.ignore_patterns("polcap"))
    for file in capture.rglob("*.*"):
        os.utime(file, ns=(OLD_NS, OLD_NS))
    options = ["process", str(capture), "--out", str(tiny_result), *TINY]
    first = polcap(*options)
    heavy = ("numpy", "scipy", "cv2", "onnxruntime")
    code = f"import atexit, sys; from polcap import cli; sys.argv[1:] = {options}\n"
    code += f"atexit.register(lambda: print('loaded', *sys.modules.keys() & {heavy}))\ncli.main()"
    again = python("-c", code)
    assert again.stdout == first.stdout + "loaded\n"
    assert again.returncode == first.returncode and again.stderr.splitlines()[:3] == first.stderr.splitlines()[:3]
