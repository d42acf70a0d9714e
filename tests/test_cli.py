"""The contract of the command line: data on stdout, one line per fault, exit codes."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from polcap import cli
from polcap.capture_values import CatalogEntry
from polcap.cli import export_command
from polcap.fusion import fused_maps
from polcap.pipeline import run as pipeline
from polcap.report import animation
from polcap.results import STAGES, ResultsUntilMask
from tests.conftest import TINY, Command, shell


def test_names_in_the_help_are_those_of_modules_that_are_not_imported_at_start() -> None:
    assert all(name in export_command._ABOUT for name in CatalogEntry.__struct_fields__)


def test_help_answers_in_a_quarter_of_a_second() -> None:
    """Time on the processor, least of five: a busy machine must not fail it."""
    spent = []
    for _ in range(5):
        before = os.times()
        done = subprocess.run([sys.executable, "-m", "polcap", "--help"], capture_output=True, text=True)
        after = os.times()
        spent.append(after.children_user + after.children_system - before.children_user - before.children_system)
    assert done.returncode == 0 and "process" in done.stdout
    assert min(spent) < 0.25


@pytest.mark.parametrize("command", [["--help"], ["help", "process"], ["status", "RESULT"]])
def test_help_and_status_import_nothing_heavy(command: list[str], tiny_result: Path) -> None:
    command = [str(tiny_result) if word == "RESULT" else word for word in command]
    code = (
        f"import sys; sys.argv[1:] = {command}; from polcap import cli\ntry: cli.main()\nfinally: print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and len(done.stdout.splitlines()) > 1
    heavy = {"numpy", "cv2", "scipy", "colour", "onnxruntime", "torch", "trimesh"}
    assert not heavy & set(done.stdout.splitlines()[-1].split())


def test_stdout_carries_data_only(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    command = ("process", tiny / "C", "--out", tiny_result, *TINY)
    assert polcap(*command).stdout == f"{tiny_result / 'asset' / 'C.glb'}\n"
    document = json.loads(polcap(*command, "--json").stdout)
    assert document["verdict"] in ("pass", "warn", "fail") and 0 < document["expected_error_deg"] < 90
    assert sorted(document["outputs"]) == ["asset", "maps", "report"]
    assert all(Path(path).exists() for path in document["outputs"].values())


def test_dry_run_prints_the_table_and_writes_nothing(example: Path, polcap: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = polcap("process", example, "--out", out, "--dry-run")
    assert done.returncode == 0 and not out.exists()
    assert "pol045/IMG_0005.DNG" in done.stdout and "surface       compute" in done.stdout
    document = json.loads(polcap("process", example, "--out", out, "--dry-run", "--json").stdout)
    assert document["stages"]["cues"] == "on demand" and len(document["capture"]["shots"]) == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--until", "polish"], "'--until': 'polish' is not one of 'hdr'"),
        (["--force", "polish"], "'--force': 'polish' is not one of 'hdr'"),
        (["--set", "hdr.clip=7"], "hdr.clip = 7"),
        (["--angles", "0,x"], "--angles 0,x"),
        (["--angles", "0,60"], "3"),
        (["--chart", "1,2,3"], "3 numbers"),
        (["--chart", "none.toml"], "none.toml"),
        (["--chart", "1,2,3,4,5,6,7,8", "--no-chart"], "exclude each other"),
        (["--mask", "none.png"], "none.png"),
        (["--model", "none.onnx"], "none.onnx"),
        (["--model", "none.onnx", "--estimator", "analytic"], "exclude each other"),
        (["--config", "none.toml"], "none.toml"),
    ],
)
def test_wrong_flag_is_one_line_and_exit_2(
    example: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], words: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.app(["process", str(example), "--out", str(tmp_path / "out"), *arguments])
    out, err = capsys.readouterr()
    assert ended.value.code == 2 and out == ""
    assert err.count("\n") == 1 and err.startswith("polcap: error: ") and words in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["process", "x", "--wath"], ["--wath", "--watch", "`polcap process --help`"]),
        (["process", "My", "vase"], ["put a path with spaces in quotes", "`polcap process --help`"]),
        (["synth", "x", "--width", "500"], ["--width", "it is a setting: --set width=…"]),
        (["process", "x", "--clip=1"], ["--clip", "it is a setting: --set hdr.clip=…"]),
        (["process"], ["missing argument 'capture'", "`polcap process --help`"]),
        (["proces", "x"], ["'proces'", "Did you mean 'process'?"]),
        (["synth", "x", "--seed", "-3"], ["'--seed'", "0"]),
        (["export", "x", "--images", "gif"], ["'gif'", "'jpeg'"]),
        (["export", "x", "--about", "date=2020", "--about", "date=2021"], ["date", "twice", "'2020'", "'2021'"]),
    ],
)
def test_a_faulty_command_line_is_one_line_and_exit_2(polcap: Command, arguments: list[str], words: list[str]) -> None:
    done = polcap(*arguments)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("polcap: error: ")
    assert all(word in done.stderr for word in words), done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "x", "--about", "title=Caf\udce9"],
        ["export", "x", "--iiif", "http://x/caf\udce9"],
        ["calibrate", "x", "--filter", "K\udce4semann"],
    ],
)
def test_an_option_that_is_not_utf8_is_one_line(arguments: list[str]) -> None:
    done = shell(*arguments)
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1
    assert arguments[2] in done.stderr and "is not UTF-8 text" in done.stderr


def test_bug_is_exit_1_with_a_traceback_only_under_debug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug\nof two lines")

    monkeypatch.setattr(pipeline, "show", fail)
    with pytest.raises(SystemExit) as ended:
        cli.app(["show", "x", "hdr"])
    assert ended.value.code == 1
    assert (
        capsys.readouterr().err
        == "polcap: bug: ZeroDivisionError: a bug of two lines; run with --debug and report it\n"
    )
    with pytest.raises(SystemExit) as ended:
        cli.app(["--debug", "show", "x", "hdr"])
    message = capsys.readouterr().err
    assert ended.value.code == 1 and message.startswith("Traceback") and message.endswith("lines above report it\n")


def test_failed_gate_is_exit_3_after_everything_is_written(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    (tiny_result / "asset" / "C.glb").unlink()
    options = (*TINY, "--set", "gates.max_normal_error_deg=0.1")
    done = polcap("process", tiny / "C", "--out", tiny_result, *options)
    assert done.returncode == 3 and (tiny_result / "asset" / "C.glb").exists()
    assert "gate failed: normal error" in done.stderr
    assert json.loads((tiny_result / "report.json").read_text())["verdict"] == "fail"


def test_open_shows_the_report_but_not_in_ci(
    tiny_result: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: not shown.append(url))  # type: ignore[func-returns-value]
    monkeypatch.setenv("CI", "true")
    assert "no browser was opened" in polcap("report", tiny_result, "--open").stderr
    monkeypatch.delenv("CI")
    polcap("report", tiny_result, "--open")
    assert shown == [(tiny_result / "report.html").as_uri()]


def test_clean_removes_the_stage_cache_only(tiny: Path, tiny_result: Path, polcap: Command, tmp_path: Path) -> None:
    copy = tiny_result
    (copy / "work" / "photograph.dng").touch()
    before = {file for file in copy.rglob("*") if file.is_file()}
    dry = json.loads(polcap("clean", copy, "--dry-run", "--json").stdout)
    assert {file for file in copy.rglob("*") if file.is_file()} == before
    done = json.loads(polcap("clean", copy, "--json").stdout)
    removed = before - {file for file in copy.rglob("*") if file.is_file()}
    assert (
        done["bytes"]
        == dry["bytes"]
        == sum((tiny / "C" / "polcap" / file.relative_to(copy)).stat().st_size for file in removed)
    )
    assert all(file.is_relative_to(copy / "work") for file in removed)
    assert sorted(path.name for path in (copy / "work").iterdir()) == ["lock", "owner", "photograph.dng"]
    assert polcap("export", copy, "--obj").returncode == 0
    assert "holds no stage cache" in polcap("show", copy, "hdr").stderr
    assert polcap("clean", tmp_path / "none").returncode == 2


def test_a_fused_object_is_refused_where_only_one_view_will_do(polcap: Command, tmp_path: Path) -> None:
    """Also if the folder of the views is named, whose result it is."""
    (tmp_path / "fused" / "maps").mkdir(parents=True)
    (tmp_path / "fused" / "maps" / "maps.json").write_text(json.dumps({"format": fused_maps.FORMAT}))
    (tmp_path / "fused" / "report.json").write_text("{}")
    for command in (("show", tmp_path, "hdr"), ("show", tmp_path, "--animate", "turntable"), ("report", tmp_path)):
        done = polcap(*command)
        assert done.returncode == 2 and "fused is a fused object: see its report.html" in done.stderr


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_can_be_shown(tiny_result: Path, stage: str) -> None:
    picture = cv2.imread(str(pipeline.show(tiny_result, [stage])[0]))
    assert picture is not None and picture.std() > 5  # there is something to see


def test_show_draws_all_stages_or_moves_the_light(
    tiny_result: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(animation, "FRAMES", 8)
    drawn = polcap("show", tiny_result, "--all").stdout.split()
    assert [Path(file).stem for file in drawn] == list(STAGES) and all(Path(file).exists() for file in drawn)
    for motion in ("light", "turntable"):
        file = Path(json.loads(polcap("show", tiny_result, "--animate", motion, "--json").stdout)["written"][0])
        done, moving = cv2.imdecodeanimation(np.fromfile(file, np.uint8))
        first, quarter = (np.asarray(moving.frames[k]).astype(float) for k in (0, 2))
        assert done and len(moving.frames) == 8
        assert np.abs(first - quarter).mean() > 3  # something moves


@pytest.mark.parametrize("options", [(), ("hdr", "--all"), ("--all", "--animate", "light")])
def test_show_wants_one_thing(tiny: Path, polcap: Command, options: tuple[str, ...]) -> None:
    done = polcap("show", tiny / "C", *options)
    assert done.returncode == 2 and "give one of a stage" in done.stderr


def test_export_needs_only_the_maps_and_prints_the_written_files(tiny_result: Path, polcap: Command) -> None:
    shutil.rmtree(tiny_result / "work")
    shutil.rmtree(tiny_result / "asset")
    done = polcap("export", tiny_result, "--gltf")
    written = [str(tiny_result / "asset" / name) for name in ("C.glb", "C.provenance.json")]
    assert done.stdout.split() == written, done.stderr
    assert sorted(str(file) for file in (tiny_result / "asset").iterdir()) == written


def test_status_and_report_print_json(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    result = tiny / "C" / "polcap"
    about = json.loads(polcap("status", result, "--json").stdout)
    assert about["complete"] and about["stages"][0]["stage"] == "hdr"
    again = json.loads(polcap("report", tiny_result, "--json").stdout)
    assert again == json.loads((result / "report.json").read_text())
    same = polcap("report", tiny_result, "--compare", result)
    assert same.stdout.startswith("Nothing changed beyond the doubt: colors agree to ΔE2000 0,")
    assert "figures and settings that differ: 0" in same.stderr
    document = json.loads(polcap("report", tiny_result, "--compare", result, "--json").stdout)
    assert [row["quantity"] for row in document["changes"]] == ["Color, ΔE2000", "Normal", "Roughness"]
    assert document["differences"] == []


def test_a_folder_of_another_kind_is_exit_2(tmp_path: Path, polcap: Command, tiny: Path) -> None:
    result = tiny / "C" / "polcap"
    cases = [((name, tmp_path), "") for name in ("status", "report", "export")] + [(("show", tmp_path, "hdr"), "")]
    cases += [(("status", tmp_path / "none"), "no such folder"), (("process", result), "it is a result of polcap")]
    shutil.copytree(result / "maps", tmp_path / "archive" / "maps")
    shutil.copy(result / "report.json", tmp_path / "archive")
    shutil.copy(tmp_path / "archive/maps/diffuse.exr", tmp_path / "archive" / "owl_layers.exr")
    for place in (result / "maps", result / "asset", tmp_path / "archive"):
        cases.append((("process", place, "--dry-run"), "a result of polcap or a part of one"))
    cases += [(("process", next(tiny.rglob("*.DNG"))), "give the folder that holds all photographs")]
    for command, words in cases:
        done = polcap(*command)
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr, done.stderr
    assert not (tmp_path / "work").exists()


def test_a_capture_names_the_result_in_it(tiny: Path, polcap: Command, tmp_path: Path) -> None:
    result = tiny / "C" / "polcap"
    shutil.copytree(result, tmp_path / "capture" / "polcap")
    assert polcap("status", tmp_path / "capture").stdout == polcap("status", result).stdout
    assert polcap("show", tmp_path / "capture", "mask").stdout.startswith(str(tmp_path / "capture" / "polcap"))
    assert polcap("report", tmp_path / "capture" / "polcap", "--compare", tmp_path / "capture").returncode == 0


def test_user_mask_replaces_the_search(copy: Path, example: Path, polcap: Command, tmp_path: Path) -> None:
    drawn = np.zeros((432, 576), np.uint8)
    drawn[120:300, 105:240] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), drawn)
    done = polcap("process", example, "--out", copy, "--mask", tmp_path / "mask.png", "--until", "mask", "--json")
    assert done.returncode == 0, done.stderr
    results, _ = pipeline.reopen(copy, ResultsUntilMask)
    assert results.object_.source == "user" and np.array_equal(results.object_.mask, drawn > 0)


def test_a_run_that_ended_early_joins_no_old_result(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    copy = tiny_result
    report = (copy / "report.json").read_bytes()
    stopped = ("process", tiny / "C", "--out", copy, *TINY, "--until", "mask")
    assert polcap(*stopped, "--set", "mask.margin=0.2").returncode == 0
    for words in (
        ("report", copy),
        ("show", copy, "selfcal"),
        ("show", copy, "--animate", "light"),
    ):
        done = polcap(*words)
        assert done.returncode == 2 and "of another run" in done.stderr, words
    assert polcap("show", copy, "mask").returncode == 0
    assert (copy / "report.json").read_bytes() == report


def test_the_asset_is_the_last_stage_and_no_part_of_another_run(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    command = ("process", tiny / "C", "--out", tiny_result, *TINY, "--until")
    (tiny_result / "asset" / "C.glb").unlink()
    assert polcap(*command, "asset").returncode in (0, 3) and (tiny_result / "asset" / "C.glb").exists()
    assert polcap(*command, "surface", "--set", "surface.back=closed").returncode == 0
    shown = polcap("show", tiny_result, "asset")
    assert shown.returncode == 2 and "of two runs" in shown.stderr


def test_maps_and_report_of_two_runs_are_not_exported(tiny_result: Path, polcap: Command) -> None:
    copy = tiny_result
    maps = json.loads((copy / "maps" / "maps.json").read_text())
    (copy / "maps" / "maps.json").write_text(json.dumps({**maps, "keys": {**maps["keys"], "mask": "other"}}))
    for words in (
        ("export", copy, "--obj"),
        ("report", copy),
        ("report", copy, "--compare", copy),
    ):
        done = polcap(*words)
        assert done.returncode == 2 and "of two runs" in done.stderr, words


def test_watch_processes_new_photographs_and_settings(example: Path, tmp_path: Path) -> None:
    folder, settings = tmp_path / "c", tmp_path / "settings.toml"
    settings.write_text("")
    shutil.copytree(example / "pol000", folder / "pol000")
    command = [sys.executable, "-m", "polcap", "process", str(folder), "--watch", "--dry-run", "--json"]
    command += ["--config", str(settings)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stderr is not None
        refused = process.stderr.readline()
        assert "add the missing shot" in refused and refused.startswith("polcap: "), refused
        assert process.stderr.readline() == f"watching {folder}; Ctrl-C ends\n"
        for name in ("pol045", "pol090"):
            shutil.copytree(example / name, folder / name)
        plan = ""
        while not plan.endswith("\n}\n"):
            plan += process.stdout.readline()
        assert len(json.loads(plan)["capture"]["shots"]) == 3
        settings.write_text("[asset]\nior = 9\n")
        lines = [process.stderr.readline() for _ in range(2)]
        assert lines[0].startswith("watching") and lines[1].startswith("polcap: asset.ior = 9"), lines
        process.send_signal(signal.SIGINT)
        assert process.wait(300) == 130
        assert process.stdout.read() == ""  # how it is meant to end is no error
    finally:
        process.kill()


def test_memory_limit_ends_with_one_line(example: Path, tmp_path: Path) -> None:
    done = shell("process", example, "--out", tmp_path, "--memory", "0.12")
    assert done.returncode == 2 and "memory" in done.stderr.splitlines()[-1], done.stderr


def test_synth_makes_a_capture_that_reads(polcap: Command, tmp_path: Path) -> None:
    small = [f"--set={text}" for text in ("width=128", "height=96", "samples=1", "exposures=1")]
    made = polcap("synth", tmp_path / "c", "--seed", 5, *small)
    named = polcap("synth", tmp_path / "named", "--json", *small).stdout
    assert json.loads(named) == {"written": [str(tmp_path / "named")]}
    assert made.stdout == f"{tmp_path / 'c'}\n", made.stderr
    assert "3 shots" in polcap("process", tmp_path / "c", "--dry-run").stdout
    assert polcap("synth", tmp_path / "d", "--set", "widht=3").returncode == 2


def test_synth_photographs_a_mesh_and_makes_data_sets(polcap: Command, tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="embreex is not installed (extra [train])")
    pytest.importorskip("torch", reason="torch is not installed (extra [train])")
    import trimesh

    trimesh.creation.box((3, 2, 1)).export(tmp_path / "box.stl")
    mesh = ("--mesh", tmp_path / "box.stl")
    small = [f"--set={text}" for text in ("width=96", "height=72", "samples=1", "exposures=1")]
    assert polcap("synth", tmp_path / "c", *mesh, "--interreflection", *small).returncode == 0
    assert json.loads((tmp_path / "c" / "truth.json").read_text())["scene"]["interreflection"] is True
    assert polcap("synth", tmp_path / "d", "--interreflection", *small).returncode == 2
    assert polcap("synth", tmp_path / "d", "--material", tmp_path, *small).returncode == 2
    assert not (tmp_path / "d").exists()
    made = polcap("synth", tmp_path / "set", *mesh, "--dataset", 1, "--set=size=64")
    assert made.returncode == 0 and made.stdout == f"{tmp_path / 'set' / 'dataset.json'}\n", made.stderr
    assert (tmp_path / "set" / "000000" / "sample.json").exists()
