"""A person turns the ring: Enter confirms, a number is the angle, no person is an error."""

import io
import os
import sys

import pytest

from polcap.errors import HardwareError, SettingError
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_rotator


def typed(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Terminal(text))


@pytest.mark.parametrize(
    ("text", "angle"),
    [
        ("\n", 45), ("44.5\n", 44.5), (" 44,5° \n", 44.5), ("-10\n", 350), ("405\n", 45), ("north\nnan\n46\n", 46),
        ("oops\n\n", 45),
    ],
)  # fmt: skip
def test_enter_confirms_the_angle_and_a_number_replaces_it(
    monkeypatch: pytest.MonkeyPatch, text: str, angle: float
) -> None:
    typed(monkeypatch, text)
    assert open_rotator("manual", Log(None)).move(45) == angle


def test_the_question_goes_to_stderr_and_the_end_of_input_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    typed(monkeypatch, "north\n")
    with pytest.raises(HardwareError, match="the input has ended; run in a terminal"):
        open_rotator("manual", Log(None)).move(22.5)
    output = capsys.readouterr()
    assert output.out == "" and "turn the polarizer to 22.5°" in output.err


@pytest.mark.parametrize("stdin", [io.StringIO("\n"), None])
def test_without_a_terminal_nobody_is_asked(monkeypatch: pytest.MonkeyPatch, stdin: io.StringIO | None) -> None:
    monkeypatch.setattr(sys, "stdin", stdin)
    with pytest.raises(SettingError, match="there is no terminal"):
        open_rotator("manual", Log(None))


def test_a_real_terminal_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    person, terminal = os.openpty()
    with os.fdopen(terminal, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        rotator = open_rotator("manual", Log(None))
        os.write(person, b"91\n")
        assert rotator.move(90) == 91
    os.close(person)
