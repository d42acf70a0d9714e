"""A batch ends although captures fail, and processes no capture twice."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from polcap import batch, config
from polcap.batch import cluster
from polcap.batch import unit as one
from polcap.chart_values import ChartRequest
from polcap.errors import CaptureError
from polcap.formats.maps import png
from polcap.pipeline.request import Request
from tests.batch.conftest import OPTIONS
from tests.conftest import ROOT, Command, shell


def test_captures_are_found_however_deep_and_results_are_not(captures: Path, tmp_path: Path) -> None:
    assert [unit.name for unit in batch.find(captures)] == ["broken", "deeper/obj1", "obj0"]
    assert [unit.name for unit in batch.find(captures / "obj0")] == ["obj0"]
    (tmp_path / "notes").mkdir()
    (tmp_path / "list.txt").write_text("obj0")
    with pytest.raises(CaptureError, match="holds no capture"):
        batch.find(tmp_path)
    with pytest.raises(CaptureError, match=r"holds one angle of a capture; give the folder of all, .*obj0$"):
        batch.find(captures / "obj0" / "pol045")


def test_results_of_process_are_no_captures(captures: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    shutil.copytree(captures / "obj0", root / "obj0")
    for part in ("maps", "asset"):
        (root / "results" / part).mkdir(parents=True)
        png.write(root / "results" / part / "normal.png", np.zeros((8, 8, 3), np.uint16))
    (root / "results" / "report.json").write_text("{}")
    assert [unit.name for unit in batch.find(root)] == ["obj0"]


@pytest.mark.parametrize(
    ("model", "estimator", "words"),
    [
        ("none.onnx", "network", "No such file or directory; give the path of an ONNX model"),
        ("noise.onnx", "network", "noise.onnx"),
        ("noise.onnx", "analytic", "--model and --estimator analytic exclude each other"),
    ],
)
def test_an_unusable_model_is_refused_before_any_capture(
    tmp_path: Path, polcap: Command, model: str, estimator: str, words: str
) -> None:
    (tmp_path / "captures" / "obj" / "pol000").mkdir(parents=True)
    (tmp_path / "noise.onnx").write_bytes(b"no model")
    order = ("--out", tmp_path / "out", "--model", tmp_path / model, "--estimator", estimator)
    done = polcap("batch", tmp_path / "captures", *order)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert words in line
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def finished(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished")
    done = shell("batch", captures, "--out", out, *OPTIONS, "--json")
    assert done.returncode == 2, done.stderr  # one is broken
    summary = json.loads(done.stdout)
    assert summary["captures"] == 3 and summary["finished"] == 2
    assert "0:00:00 left" in done.stderr
    return out


def test_broken_capture_stops_no_other_and_is_listed_with_its_remedy(finished: Path) -> None:
    rows = {row["name"]: row for row in json.loads((finished / "polcap-batch/summary.json").read_text())["rows"]}
    assert rows["broken"]["state"] == "failed" and "copy it from the card again" in rows["broken"]["says"]
    for name in ("obj0", "deeper/obj1"):
        assert rows[name]["state"] in ("done", "gates")
        assert (finished / name / "asset" / f"{Path(name).name}.glb").exists()
        assert rows[name]["verdict"] in ("pass", "warn", "fail") and rows[name]["expected_error_deg"] > 0
    page = (finished / "polcap-batch/summary.html").read_text()
    for link in re.findall(r'(?:href|src)="([^"]*)"', page):
        assert (finished / "polcap-batch" / unquote(link)).is_file(), link
    table = list(csv.DictReader((finished / "polcap-batch/summary.csv").read_text().splitlines()))
    assert {row["name"]: row["report"] for row in table} == {name: row["report"] for name, row in rows.items()}
    assert page.count("<figure>") == 2 and "copy it from the card again" in page


def test_views_and_maps_of_a_fused_object_are_no_captures(tmp_path: Path) -> None:
    for name in ("cup/view01", "cup/view02", "jug"):
        for angle in ("pol000", "pol045", "pol090"):
            (tmp_path / name / angle).mkdir(parents=True)
    (tmp_path / "cup/fused/maps").mkdir(parents=True)
    assert [unit.name for unit in batch.find(tmp_path)] == ["cup/view01", "cup/view02", "jug"]
    (tmp_path / "cup/fused/report.json").touch()
    assert [unit.name for unit in batch.find(tmp_path)] == ["jug"]


def test_views_of_one_object_are_named(captures: Path, tmp_path: Path, polcap: Command) -> None:
    for name in ("cup/view01", "cup/view02"):
        shutil.copytree(captures / "broken", tmp_path / name)
    done = polcap("batch", tmp_path, *OPTIONS)
    assert f"{tmp_path / 'cup'}: view01 to view02 are views of one object; `polcap fuse` joins them" in done.stderr
    assert "(a flat sample: `polcap material`)" in done.stderr


def test_folders_without_a_capture_are_named(captures: Path, tmp_path: Path, polcap: Command) -> None:
    for name in ("broken", "lost"):
        (tmp_path / name).mkdir()
    shutil.copytree(captures / "broken", tmp_path / "broken", dirs_exist_ok=True)
    for name in ("cup/fused", "jug/fused", "results/vase"):
        (tmp_path / name / "maps").mkdir(parents=True)
        (tmp_path / name / "report.json").touch()
    done = polcap("batch", tmp_path, *OPTIONS)
    assert "no capture in lost: " in done.stderr and done.returncode == 2 and "views of one object" not in done.stderr
    assert "no capture" not in polcap("batch", tmp_path / "broken", *OPTIONS).stderr


def test_second_run_opens_no_finished_capture(captures: Path, finished: Path, polcap: Command) -> None:
    before = (finished / "obj0/report.json").stat().st_mtime_ns
    done = polcap("batch", captures, "--out", finished, *OPTIONS, "--shard", "3/3")
    assert "finished before: 1" in done.stderr and done.returncode in (0, 3)
    assert (finished / "obj0/report.json").stat().st_mtime_ns == before


def test_a_changed_setting_is_processed_again(captures: Path, finished: Path) -> None:
    units = [unit for unit in batch.find(captures, finished) if unit.name == "obj0"]
    folders = Path(units[0].capture), Path(units[0].out)
    other = Request(config=config.load(assignments=["hdr.clip=0.9"]))
    assert one.find_finished(units[0], Request()) is None
    assert Request().digest(*folders) != other.digest(*folders)


def test_an_edited_table_ends_a_run_before_its_first_capture(captures: Path, finished: Path, polcap: Command) -> None:
    table = finished / "polcap-batch" / "summary.csv"
    before = table.read_bytes()
    table.write_bytes(before + b"seen,by me\n")
    done = polcap("batch", captures, "--out", finished, *OPTIONS)
    assert done.returncode == 2 and "summary.csv: it was edited" in done.stderr and "shard" not in done.stderr
    table.write_bytes(before)


def test_status_lists_every_capture(finished: Path, polcap: Command) -> None:
    about = json.loads(polcap("status", finished, "--json").stdout)
    assert about["states"]["failed"] == 1 and about["finished"] == 2
    assert "2 of 3 finished" in polcap("status", finished).stdout


def test_clean_goes_through_a_batch(finished: Path, polcap: Command) -> None:
    removed = json.loads(polcap("clean", finished, "--json", "--dry-run").stdout)["removed"]
    emptied = {name for name, size in removed.items() if size}
    assert emptied == {str(finished / name / "work") for name in ("obj0", "deeper/obj1")}


def test_fail_fast_stops(captures: Path, tmp_path: Path, polcap: Command) -> None:
    done = polcap("batch", captures, "--out", tmp_path, *OPTIONS, "--fail-fast", "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["states"] == {"failed": 1, "todo": 2}


def start(captures: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "polcap", "batch", str(captures / "obj0"), "--out", str(out), *OPTIONS, *more]
    long = out / ("t" * 120)  # longer than the path of a Unix socket may be
    long.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(long)}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def kill_worker(out: Path) -> None:
    """Kill the process that works on the capture, by the number in its record."""
    for _ in range(8000):
        for file in (out / "polcap-batch" / "records").glob("[!.]*.json"):  # no temporary ones
            record = json.loads(file.read_text())
            if record["state"] == "running" and any((out / "obj0").glob("work/01-hdr")):
                with suppress(ProcessLookupError):  # it was quicker
                    os.kill(record["pid"], signal.SIGKILL)
                return
        time.sleep(0.05)
    raise AssertionError("no worker began")


@pytest.mark.parametrize("how", [(), ("--scheduler", "local", "--workers", "1")], ids=["processes", "dask"])
def test_killed_worker_costs_nothing_but_time_under_a_temporary_folder_of_any_length(
    captures: Path, finished: Path, tmp_path: Path, how: tuple[str, ...]
) -> None:
    if how:
        pytest.importorskip("distributed")
    running = start(captures, tmp_path, *how)
    kill_worker(tmp_path)
    _, errors = running.communicate(timeout=300)
    assert running.returncode in (0, 3), errors
    again = (tmp_path / "obj0/asset/obj0.glb").read_bytes()
    assert again == (finished / "obj0/asset/obj0.glb").read_bytes()


def test_scheduler_that_does_not_answer_is_named(
    captures: Path, tmp_path: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.3)
    done = polcap("batch", captures, "--out", tmp_path, *OPTIONS, "--scheduler", "tcp://127.0.0.1:9")
    assert done.returncode == 2 and "tcp://127.0.0.1:9: no scheduler answers there" in done.stderr


def finish_and_die(unit: one.Unit, request: Request, attempt: int) -> None:
    """Process a capture, and kill the worker before it reports."""
    one.run(unit, request, attempt)
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_capture_stays_done_if_its_dask_worker_dies_afterwards(
    captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    (unit,) = [unit for unit in batch.find(captures, tmp_path) if unit.name == "obj0"]
    request = Request(chart=ChartRequest("none"), estimator="analytic")
    monkeypatch.setattr("polcap.batch.cluster.units.run", finish_and_die)
    (record,) = cluster.run([unit], request, "local", 1, 0, lambda line: None)
    assert record.state in one.FINISHED and one.read_record(unit) == record
    written = unit.record_file.stat().st_mtime_ns
    monkeypatch.undo()
    assert one.run(unit, request) == record  # as Dask repeats a task that a dead worker had ended
    assert unit.record_file.stat().st_mtime_ns == written


def test_a_local_cluster_listens_on_this_machine_only(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")
    hosts = list[str]()

    def note(*_: object) -> Iterator[one.UnitRecord]:
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        ports = [port for process in family for port in process.net_connections("inet")]
        hosts.extend(port.laddr.ip for port in ports if port.status == psutil.CONN_LISTEN)
        return iter(())

    monkeypatch.setattr(cluster, "_gather", note)
    assert list(cluster.run([], Request(), "local", 1, 0, lambda line: None)) == []
    assert len(hosts) >= 3 and set(hosts) == {"127.0.0.1"}  # scheduler, dashboard, worker
