"""A capture of any name gets a record, and the record knows whether its process still runs."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from polcap import batch
from polcap.batch import contact_sheet
from polcap.batch import unit as one

ANALYTIC = one.ProcessOptions({}, estimator="analytic")


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
