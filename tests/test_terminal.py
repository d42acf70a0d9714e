"""What a command says, where, and with which exit code."""

import json
import time
from itertools import chain
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from polcap import __version__, cli, terminal
from polcap.pipeline import run as pipeline
from tests.conftest import Command


def test_short_help_and_completion_are_there(polcap: Command) -> None:
    text = polcap("-h").stdout
    assert "--version" in text and "--install-completion" in text
    assert polcap("--version") == (0, f"{__version__}\n", "")


def test_with_json_an_error_is_a_document_too(polcap: Command, tmp_path: Path) -> None:
    done = polcap("process", tmp_path / "none", "--json")
    said = json.loads(done.stdout)["error"]
    assert done.returncode == said["exit_code"] == 2 and "no such folder" in said["says"]
    assert "no such folder" in done.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("process",), "missing argument"),
        (("batch", "none", "--worker", "2"), "--worker"),
        (("export", "none", "--lod", "many"), "--lod"),
        (("procces", "none"), "procces"),
    ],
)
def test_with_json_a_command_line_that_is_none_is_a_document_too(
    polcap: Command, words: tuple[str, ...], says: str
) -> None:
    done = polcap(*words, "--json")
    said = json.loads(done.stdout)["error"]
    assert done.returncode == said["exit_code"] == 2 and said["kind"] == "SettingError"
    assert says in said["says"] and says in done.stderr
    assert polcap(*words).stdout == ""


def test_with_json_an_interruption_is_a_document_too(polcap: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "show", interrupted)
    done = polcap("show", "none", "hdr", "--json")
    said = json.loads(done.stdout)["error"]
    assert done.returncode == said["exit_code"] == 130 and "run the same command again" in said["says"]


def test_no_choice_minds_case() -> None:
    hints = [get_type_hints(command.callback, include_extras=True) for command in cli.app.registered_commands]
    declared = [get_args(hint) for hint in chain.from_iterable(one.values() for one in hints)]
    choices = [info for kind, *info in filter(None, declared) if "Literal[" in str(kind)]
    assert len(choices) > 10 and not any(info[0].case_sensitive for info in choices)


def test_a_photograph_instead_of_its_folder_is_told(polcap: Command, example: Path) -> None:
    done = polcap("process", next(example.rglob("*.DNG")))
    assert done.returncode == 2 and "give the folder that holds all photographs" in done.stderr


def test_frames_are_told_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 2.0, 6.0, 8.0, 12.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    steps = terminal.Steps()
    for done in (1, 2, 3, 4):
        steps.frame(done, 9)
    assert capsys.readouterr().err.splitlines() == ["2 of 9 frames, 21 s left", "4 of 9 frames, 15 s left"]
