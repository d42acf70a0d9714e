"""The firmware in `examples/`, compiled for this computer: it speaks the line protocol, in real time."""

import os
import shutil
import subprocess
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from polcap.errors import HardwareError
from polcap.rig import device_urls, motor_line_protocol, serial_port
from polcap.rig.device_log import Log
from polcap.rig.device_urls import open_rotator, probe
from tests.conftest import ROOT

pytestmark = pytest.mark.timeout(120)
STEPS_PER_DEGREE = 26.6667  # of the sketch


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The board is a process of its own; a busy machine may delay it."""
    monkeypatch.setattr(serial_port, "ANSWER_S", 20.0)
    monkeypatch.setattr(motor_line_protocol, "_START_S", 60.0)
    elliptec, boards = device_urls._QUESTIONS
    monkeypatch.setattr(device_urls, "_QUESTIONS", [elliptec, (*boards[:2], 60.0, boards[3])])


class Board(NamedTuple):
    port: str
    switch_deg: float
    process: "subprocess.Popen[str]"

    def released_deg(self) -> float:
        """Angle at which the ring was released."""
        self.process.kill()
        lines = self.process.communicate(timeout=30)[1].splitlines()
        return int(lines[-1].split()[1]) / STEPS_PER_DEGREE


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("g++") is None:
        pytest.skip("needs g++")
    folder = tmp_path_factory.mktemp("firmware")
    program, sketch, shim = folder / "rotator", folder / "rotator_firmware.ino", Path(__file__).with_name("arduino.h")
    text = (ROOT / "examples" / "rotator_firmware" / "rotator_firmware.ino").read_text()
    sketch.write_text(text.replace("SPEED = 60.0", "SPEED = 600.0"))  # the simulated ring has no inertia
    flags = ["-Wall", "-Wextra", "-Werror", "-include", str(shim), "-x", "c++"]
    subprocess.run(["g++", *flags, str(sketch), "-o", str(program)], check=True, timeout=120)
    return program


@pytest.fixture
def board(firmware: Path, request: pytest.FixtureRequest) -> Iterator[Board]:
    """A ring at 20° with its switch at `param` degrees."""
    master, slave = os.openpty()
    tty.setraw(slave)
    steps = [str(round(STEPS_PER_DEGREE * degrees)) for degrees in (20, request.param)]
    process = subprocess.Popen([firmware, *steps], stdin=master, stdout=master, stderr=subprocess.PIPE, text=True)
    yield Board(os.ttyname(slave), request.param, process)
    process.kill()
    process.communicate(timeout=30)
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("board", [5, 25], indirect=True)  # the second starts on its switch
def test_the_firmware_turns_the_ring_and_releases_it(board: Board) -> None:
    rotator = open_rotator(f"line:{board.port}?settle=0", Log(None))
    assert rotator.model == "polcap-rotator stepper"
    for angle in (0.0, 45.0, 30.0):
        assert rotator.move(angle) == pytest.approx(angle, abs=0.02)
    rotator.close()
    assert board.released_deg() == pytest.approx(board.switch_deg + 30, abs=0.06)


@pytest.mark.parametrize("board", [-500], indirect=True)
def test_the_firmware_refuses_what_it_cannot_do(board: Board) -> None:
    assert probe(board.port) == "polcap-rotator stepper"
    port = serial_port.Port(board.port, motor_line_protocol.LineMotor.baud, Log(None))
    answers = []
    for command in ("go 10", "where", "jump", "zero", "go north", "go 1e9", "go 5 6", "go -2.5", "stop", "where"):
        port.send(f"{command}\r\n")
        while (answer := port.read_line(30)).startswith("polcap-rotator"):  # it has just started, and been asked
            pass
        answers.append(answer)
    refused = ["error home first", "error home first", "error unknown command", "ok 0.000", *["error no angle"] * 3]
    assert answers == [*refused, "ok -2.512", "ok -2.512", "error home first"]  # 67 steps


@pytest.mark.parametrize("board", [-500], indirect=True)
def test_the_firmware_gives_up_on_a_missing_switch_and_is_busy_until_then(board: Board, tmp_path: Path) -> None:
    log = tmp_path / "rig.log"
    with pytest.raises(HardwareError, match="the switch was not found in 400 degrees; check its wiring"):
        open_rotator(f"line:{board.port}?settle=0", Log(log)).home()
    assert " rotator < busy -" in log.read_text()
