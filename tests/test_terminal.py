"""Messages of the commands, their streams and exit codes."""

import json
import os
import shlex
import subprocess
import sys
import time
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from polcap import __version__, cli, terminal
from polcap.cli import options
from polcap.material.material_path import all_settings
from polcap.pipeline import run as pipeline
from tests.conftest import Command, environment


def test_short_help_and_completion_are_there(polcap: Command) -> None:
    text = polcap("-h").stdout
    assert "--version" in text and "--install-completion" in text
    assert polcap("--version") == (0, f"{__version__}\n", "")


def test_help_has_complete_summaries_and_explains_a_command(polcap: Command) -> None:
    text = polcap("help").stdout
    assert text == polcap("--help").stdout and "..." not in text.partition("Commands")[2]
    assert all(f"  {command.__name__} " in text for command in cli.COMMANDS)
    assert polcap("help", "export").stdout == polcap("export", "-h").stdout
    assert "Did you mean 'export'" in polcap("help", "exprt").stderr


def test_settings_are_listed_with_default_range_and_meaning(polcap: Command) -> None:
    every = json.loads(polcap("settings", "--json").stdout)
    assert [row["name"] for row in every] == [setting.key for setting in all_settings()]
    of_stage = json.loads(polcap("settings", "hdr", "--json").stdout)
    assert of_stage == [row for row in every if row["name"].startswith("hdr.")]
    assert "fusion.atlas.size = 0  (≥ 0, ≤ 8192)" in polcap("settings", "fusion").stdout
    assert "hdr.clip = 0.98  (≥ 0.5, ≤ 1.0)\n    clipping threshold" in polcap("settings", "hdr").stdout
    assert "stokes.undistort = true\n" in polcap("settings", "stokes").stdout
    assert "there are hdr, whitebalance" in polcap("settings", "polish").stderr
    of_synth = json.loads(polcap("settings", "synth", "--json").stdout)
    assert all(row["meaning"] for row in of_synth)
    assert any("write -45 as 135" in row["meaning"] for row in of_synth if row["name"] == "angles_deg")
    assert {"--views", "--flat", "--calibration"} <= {row["meaning"].partition(":")[0][5:] for row in of_synth}


def test_quiet_prints_only_data_and_errors_wherever_it_is(polcap: Command, tmp_path: Path) -> None:
    small = ("--rotator", "simulated?settle=0", "--camera", "simulated?width=96&height=72&samples=1", "--no-check")
    assert polcap("capture", tmp_path / "c", *small, "-q") == (0, f"{tmp_path / 'c'}\n", "")
    assert polcap("-q", "process", tmp_path / "none").stderr.startswith("polcap: error: ")


def test_log_has_all_messages_with_time_level_and_versions(polcap: Command, tmp_path: Path) -> None:
    log = tmp_path / "one log.txt"
    small = ("--rotator", "simulated?settle=0", "--camera", "simulated?width=96&height=72&samples=1", "--no-check")
    assert polcap("capture", tmp_path / "c", *small, "-q", "--log", log).stderr == ""
    failed = polcap("process", tmp_path / "none", f"--log={log}")
    rows = [row.split(" ", 1) for row in log.read_text(encoding="utf-8").splitlines()]
    assert all(datetime.fromisoformat(time).tzinfo for time, _ in rows)
    texts = [text for _, text in rows]
    assert texts[0].startswith("INFO    polcap ") and f"polcap {__version__}, numpy " in texts[1]
    assert any("pol000" in text for text in texts)
    assert texts[-1] == f"ERROR   {failed.stderr.rstrip()}"


def test_log_has_the_traceback_of_a_bug(polcap: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "show", lambda *_: 1 / 0)
    assert "Traceback" not in polcap("show", "x", "hdr", "--log", tmp_path / "log").stderr
    assert "ERROR   ZeroDivisionError" in (tmp_path / "log").read_text(encoding="utf-8")


@pytest.mark.parametrize("words", [("--log",), ("--log", "none/file")])
def test_a_log_that_cannot_be_written_is_one_line(polcap: Command, words: tuple[str, ...]) -> None:
    done = polcap("process", "none", *words)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--log" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("process", "none"), "no such folder"),
        (("process",), "missing argument"),
        (("batch", "none", "--worker", "2"), "--worker"),
        (("export", "none", "--lod", "many"), "--lod"),
        (("procces", "none"), "procces"),
    ],
)
def test_with_json_an_error_is_a_document_too(polcap: Command, words: tuple[str, ...], message: str) -> None:
    done = polcap(*words, "--json")
    error = json.loads(done.stdout)["error"]
    assert done.returncode == error["exit_code"] == 2 and message in error["says"] and message in done.stderr
    assert polcap(*words).stdout == ""


@pytest.mark.parametrize(
    ("words", "how"),
    [(("show", "none", "hdr", "--json"), ""), (("train", "x"), " with --resume"), (("evaluate", "x", "y"), "")],
)
def test_an_interruption_is_one_line_with_the_remedy(
    polcap: Command, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], how: str
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "show", interrupted)
    monkeypatch.setattr(options, "training", interrupted)
    done = polcap(*words)
    assert done.returncode == 130
    assert done.stderr.splitlines()[-1] == f"polcap: interrupted; run the same command again{how} to go on"
    assert ("--json" in words) == ("run the same command again" in done.stdout)


def test_no_choice_depends_on_case() -> None:
    hints = [get_type_hints(command.callback, include_extras=True) for command in cli.app.registered_commands]
    declared = [get_args(hint) for hint in chain.from_iterable(one.values() for one in hints)]
    choices = [info for kind, *info in filter(None, declared) if "Literal[" in str(kind)]
    assert len(choices) > 10 and not any(info[0].case_sensitive for info in choices)


def test_frames_are_reported_every_five_seconds_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 2.0, 6.0, 8.0, 12.0, 12.1])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    steps = terminal.Steps()
    for done in (1, 2, 3, 4):
        steps.frame(done, 9)
    assert capsys.readouterr().err.splitlines() == ["2 of 9 frames, 21 s left", "4 of 9 frames, 15 s left"]
    terminal.set_verbosity(quiet=False, verbose=True, debug=False)
    steps.frame(5, 9)
    terminal.set_verbosity(quiet=False, verbose=False, debug=False)
    assert capsys.readouterr().err.startswith("5 of 9 frames")


@pytest.mark.parametrize(
    ("words", "values"),
    [
        ("export r --preset u", ["unreal", "unity"]),
        ("export r --extra d", ["displacement"]),
        ("process c --until s", ["selfcal", "stokes", "surface"]),
        ("export r --images w", ["webp"]),
    ],
)
def test_the_shell_completes_values(
    polcap: Command, monkeypatch: pytest.MonkeyPatch, words: str, values: list[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["polcap"])
    line = {"COMP_WORDS": f"polcap {words}", "COMP_CWORD": str(len(words.split())), "_POLCAP_COMPLETE": "complete_bash"}
    for name, value in line.items():
        monkeypatch.setenv(name, value)
    assert polcap().stdout.split() == values


def redirected(words: str, streams: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `polcap …` in a shell that redirects its streams."""
    command = f"{shlex.quote(sys.executable)} -m polcap {words} {streams}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=environment(), timeout=300)
    return done.returncode, done.stdout, done.stderr


SHELL = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full and a shell")


@SHELL
@pytest.mark.parametrize(
    ("words", "streams", "code"),
    [
        ("--version", ">&-", 0), ("--version", ">&- 2>&- <&-", 0), ("--version", "2>/dev/full", 0),
        ("--version", ">/dev/full", 2), ("--version", ">/dev/full 2>/dev/full", 2),
        ("settings hdr --json", ">/dev/full 2>&-", 2), ("status none", ">&- 2>/dev/full", 2),
        ("status none", "2>&-", 2),
    ],
)  # fmt: skip
def test_a_closed_or_full_stream_ends_by_an_honest_exit_code(words: str, streams: str, code: int) -> None:
    ended, _, errors = redirected(words, streams)
    lost = "polcap: error: standard output is incomplete: No space left on device; write it elsewhere\n"
    assert (ended, errors) == (code, lost if streams == ">/dev/full" else "")


@SHELL
def test_every_command_prints_its_help_to_a_full_stream_without_a_traceback() -> None:
    calls = "; ".join(f"main('{command.__name__}')" for command in cli.COMMANDS)
    program = (
        "import sys; from polcap import cli, terminal; terminal.open_streams(); codes = set()\n"
        "def main(name):\n    try: cli.app([name, '--help'])\n    except SystemExit as end: codes.add(end.code)\n"
        f"{calls}\nsys.exit(0 if codes == {{2}} else 1)"
    )
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, env=environment())
    assert done.returncode == 0 and b"Traceback" not in done.stderr


@SHELL
def test_work_goes_on_where_no_stream_can_be_written(tmp_path: Path) -> None:
    small = " ".join(f"--set {one}" for one in ("width=96", "height=96", "samples=1", "exposures=1"))
    made = redirected(f"synth {tmp_path}/c {small} --log {tmp_path}/log", ">&- 2>&- <&-")
    assert made == (0, "", "") and "polcap synth" in (tmp_path / "log").read_text(encoding="utf-8")
    options = "--no-chart --estimator analytic --log /dev/full"
    code, _, errors = redirected(f"process {tmp_path}/c {options}", ">/dev/full")
    assert code in (2, 3) and (tmp_path / "c/polcap/asset/c.glb").exists()
    assert "standard output is incomplete" in errors and "--log is incomplete" in errors
    assert redirected(f"process {tmp_path}/c {options}", ">&- 2>/dev/full") == (code, "", "")


@SHELL
def test_a_reader_that_ends_early_is_no_error() -> None:
    code, _, errors = redirected("settings --json", "| true; exit ${PIPESTATUS[0]}")
    assert (code, errors) == (0, "")
    assert redirected("status none", "2> >(true)")[0] == 2
