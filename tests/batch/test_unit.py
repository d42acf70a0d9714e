"""A capture of any name gets a record, and the record knows whether its process still runs."""

import csv
import json
import os
import socket
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from polcap import batch
from polcap.batch import contact_sheet
from polcap.batch import unit as one
from polcap.pipeline.request import Request

ANALYTIC = Request(estimator="analytic")


def only_unit(root: Path, name: str) -> one.Unit:
    try:
        (root / name / "pol000").mkdir(parents=True)
    except OSError as error:
        pytest.skip(f"this file system has no such name ({error.strerror})")
    (unit,) = batch.find(root)
    return unit


@pytest.mark.parametrize(
    "name", [os.fsdecode(b"bad\xff"), "\N{CJK UNIFIED IDEOGRAPH-5B57}" * 84], ids=["bytes", "long"]
)
def test_a_capture_of_any_name_is_recorded(tmp_path: Path, name: str) -> None:
    unit = only_unit(tmp_path, name)
    record = one.run(unit, ANALYTIC)
    assert record.state == "failed" and "holds no photograph" in record.message
    assert one.read_record(unit) == record
    contact_sheet.write(Path(unit.batch_folder), [unit], [record])
    (row,) = json.loads((Path(unit.batch_folder) / "summary.json").read_text(encoding="utf-8"))["rows"]
    assert row["name"] == name


@pytest.mark.parametrize("alive", [False, True])
def test_windows_processes_are_checked_without_a_signal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, alive: bool
) -> None:
    """On Windows `os.kill(pid, 0)` would be Ctrl-C to the running batch."""
    unit = only_unit(tmp_path, "obj")
    one.write_record(unit, one.UnitRecord("obj", "running", host=socket.gethostname(), pid=4711))
    listed = '"python.exe","4711","Console"' if alive else "INFO: No tasks are running"
    monkeypatch.setattr(subprocess, "run", lambda *_, **options: SimpleNamespace(stdout=listed))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a signal was sent"))
    monkeypatch.setattr(sys, "platform", "win32")
    assert one.read_record(unit).state == ("running" if alive else "interrupted")


@pytest.mark.parametrize("blocked", [False, True])
def test_the_record_of_a_bug_states_where_its_traceback_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, blocked: bool
) -> None:
    unit = only_unit(tmp_path, "obj")
    file = unit.record_file.with_suffix(".txt")
    if blocked:
        file.mkdir(parents=True)  # no file can have this name
    monkeypatch.setattr(one, "_process", lambda unit, options: 1 / 0)
    record = one.run(unit, ANALYTIC)
    assert record.state == "bug" and record.message.startswith("ZeroDivisionError: division by zero; the traceback ")
    assert record.message.endswith(f"is in {file}") != blocked and file.is_file() != blocked


class Elements(HTMLParser):
    """The elements of a page and their attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.names, self.attributes = set[str](), set[str]()

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.names.add(tag)
        self.attributes |= {name for name, _ in attrs}


@pytest.mark.parametrize("text", ["<script>alert(1)</script>", '" onerror="alert(1)', "'><img src=x>", "&lt;b&gt;"])
def test_no_text_of_a_record_becomes_an_element_of_the_summary(tmp_path: Path, text: str) -> None:
    unit = only_unit(tmp_path, "obj")
    unit.thumbnail_file.parent.mkdir(parents=True)
    unit.thumbnail_file.touch()
    pages = []
    for shown in ("obj", text):
        record = one.UnitRecord(shown, "gates", shown, verdict=shown, expected_error_deg=3.0, asset=shown, report=shown)
        contact_sheet.write(Path(unit.batch_folder), [unit], [record])
        pages.append(Elements())
        pages[-1].feed((Path(unit.batch_folder) / "summary.html").read_text(encoding="utf-8"))
    assert pages[1].names == pages[0].names and pages[1].attributes == pages[0].attributes


def test_a_warning_is_listed_with_its_reason(tmp_path: Path) -> None:
    unit = only_unit(tmp_path, "obj")
    for verdict in ("pass", "warn"):
        record = one.UnitRecord("obj", "done", "focal length: in doubt.", verdict=verdict)
        contact_sheet.write(Path(unit.batch_folder), [unit], [record])
        page = (Path(unit.batch_folder) / "summary.html").read_text(encoding="utf-8")
        assert ("in doubt" in page) == ("done warn" in page) == (verdict == "warn")


@pytest.mark.parametrize(
    "address", ["//elsewhere.example/x", "https://elsewhere.example", "javascript:alert(1)", "\ud800"]
)
def test_the_links_of_the_summary_stay_on_this_machine(tmp_path: Path, address: str) -> None:
    unit = only_unit(tmp_path, "obj")
    unit.thumbnail_file.parent.mkdir(parents=True)
    unit.thumbnail_file.touch()
    contact_sheet.write(Path(unit.batch_folder), [unit], [one.UnitRecord("obj", "done", asset=address, report=address)])
    page = (Path(unit.batch_folder) / "summary.html").read_text(encoding="utf-8")
    assert page.count('href="./') == page.count("href=") == 2


@pytest.mark.parametrize(
    "text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "\n=1", " =1", "＝1", "=cmd|'/c calc'!A0"]
)
def test_no_cell_of_the_table_is_a_formula(tmp_path: Path, text: str) -> None:
    unit = only_unit(tmp_path, "obj")
    record = one.UnitRecord(text, "todo", text, seconds=2.5, verdict=text, asset=text, report=text)
    contact_sheet.write(Path(unit.batch_folder), [unit], [record])
    with (Path(unit.batch_folder) / "summary.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert {row[name] for name in ("name", "says", "verdict", "asset", "report")} == {f"'{text}"}
    assert row["seconds"] == "2.5"


@pytest.mark.parametrize(
    "text",
    ["", "[]", "null", "7", "[" * 30_000, '{"name": 3}', '{"seconds": 1}', '{"name": "obj", "state": "odd"}',
     '{"name": "obj", "seconds": NaN}', '{"name": "obj", "seconds": 1e999}',
     '{"name": "obj", "expected_error_deg": Infinity}'],
)  # fmt: skip
def test_a_record_of_another_shape_is_none(tmp_path: Path, text: str) -> None:
    unit = only_unit(tmp_path, "obj")
    unit.record_file.parent.mkdir(parents=True)
    unit.record_file.write_text(text)
    assert one.read_record(unit) == one.UnitRecord("obj")


def test_a_capture_that_was_finished_before_its_process_died_stays_finished(tmp_path: Path) -> None:
    unit = only_unit(tmp_path, "obj")
    before = one.read_record(unit)
    one.write_record(unit, done := one.UnitRecord("obj", "done", seconds=3.0))
    assert one.record_crash(unit, before, "its process died", 3) == one.read_record(unit) == done
    assert one.record_crash(unit, done, "its process died", 3).state == "crashed"  # of an earlier batch


@pytest.mark.parametrize("text", ["", "[]", "7", '{"root": 7, "out": null}', '{"root": "/", "out": NaN}', "[" * 30_000])
def test_a_batch_whose_note_has_another_shape_is_searched_for_captures(tmp_path: Path, text: str) -> None:
    unit = only_unit(tmp_path, "obj")
    (tmp_path / "polcap-batch").mkdir()
    (tmp_path / "polcap-batch" / "batch.json").write_text(text)
    assert batch.reopen(tmp_path) == [unit]
