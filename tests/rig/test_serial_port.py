"""Every failure of a port is one error, in time; the log has every line."""

import os
import re
import socket
import threading
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from polcap.errors import HardwareError, SettingError, StorageError
from polcap.rig import serial_port
from polcap.rig.device_log import Log
from polcap.rig.serial_port import NoAnswer, Port, Unplugged

pytestmark = pytest.mark.timeout(60)


class Wire:
    """The far end of a pseudo-terminal, and the port on it."""

    def __init__(self, log: Log) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.name = os.ttyname(self.slave)
        self.port = Port(self.name, 9600, log)

    def answer(self, question: str, data: bytes) -> None:
        self.port.send(question)
        os.write(self.master, data)

    def cut(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def wire(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    monkeypatch.setattr(serial_port, "ANSWER_S", 0.2)
    monkeypatch.setattr(serial_port, "_LATE_S", 0.1)
    wire = Wire(Log(tmp_path / "rig.log"))
    yield wire
    wire.port.close()
    with suppress(OSError):  # a test has cut it
        wire.cut()


def test_lines_come_without_their_ends_and_empty_lines_are_skipped(wire: Wire) -> None:
    wire.answer("0gp", b"\r\n0PO00000000\r\n\nok\n")
    assert [wire.port.read_line(), wire.port.read_line()] == ["0PO00000000", "ok"]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"", "nothing within 0.2 s; "),
        (b"0PO00", "only '0PO00'"),
        (b"\xff\x00\x87~\r\n", ".*not text"),
        (b"x" * 2000, "only 'xxx"),
    ],
)
def test_no_answer_is_an_error_with_port_and_question(wire: Wire, answer: bytes, words: str) -> None:
    wire.answer("0gp", answer)
    with pytest.raises(NoAnswer, match=f"rotator on {wire.name} answered '0gp' with {words}"):
        wire.port.read_line()


def test_half_a_line_does_not_join_the_next_answer(wire: Wire) -> None:
    wire.answer("0gp", b"0PO00")
    with pytest.raises(NoAnswer):
        wire.port.read_line()
    os.write(wire.master, b"000001\r\n")  # the rest of it, late
    wire.answer("0gs", b"0GS00\r\n")
    assert wire.port.read_line() == "0GS00"


def test_a_second_answer_is_not_taken_for_that_of_the_next_question(wire: Wire) -> None:
    wire.answer("0gp", b"0PO00000001\r\n0PO00000001\r\n")
    assert wire.port.read_line() == "0PO00000001"
    wire.answer("0gs", b"0GS00\r\n")
    assert wire.port.read_line() == "0GS00"


def test_a_pulled_cable_is_unplugged_whether_reading_or_sending(wire: Wire) -> None:
    cut = threading.Timer(0.1, wire.cut)
    cut.start()
    with pytest.raises(Unplugged, match=f"{wire.name} is gone"):
        wire.port.read_line(30)
    cut.join()
    for discard in (True, False):
        with pytest.raises(Unplugged):
            wire.port.send("0gp", discard)


def test_a_second_opener_is_refused(wire: Wire) -> None:
    with pytest.raises(HardwareError, match="another program holds it"):
        Port(wire.name, 9600, Log(None))
    wire.port.close()
    Port(wire.name, 9600, Log(None)).close()


@pytest.mark.parametrize(
    ("url", "error", "words"),
    [
        ("/dev/no-such-port", HardwareError, "there is no such port"),
        ("socket://127.0.0.1:9", HardwareError, "nothing listens there"),
        ("socket://127.0.0.1", HardwareError, "cannot open socket://127.0.0.1"),
        ("carrier-pigeon://1", SettingError, "is no serial port"),
    ],
)
def test_a_port_that_cannot_be_opened_is_an_error_with_the_reason(url: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Port(url, 9600, Log(None))


def test_a_socket_is_a_port_and_its_end_unplugs_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = Port(f"socket://127.0.0.1:{server.getsockname()[1]}", 9600, Log(None))
        far, _ = server.accept()
        port.send("?\n")
        assert far.recv(10) == b"?\n"
        far.sendall(b"ok\n")
        assert port.read_line(30) == "ok"
        far.close()
        with pytest.raises(Unplugged):
            port.read_line(30)


def test_the_log_has_every_line_with_its_time_and_is_continued(wire: Wire, tmp_path: Path) -> None:
    wire.answer("0gp\r\n", b"0PO00\xff\r\n")
    with pytest.raises(NoAnswer):
        wire.port.read_line()
    wire.port.log.close()
    wire.port.log.write("rotator", ">", "after the end")
    Log(tmp_path / "rig.log").write("camera", "!", "continued")
    lines = (tmp_path / "rig.log").read_text().splitlines()
    stamp = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}"
    wanted = ["rotator > 0gp", r"rotator < 0PO00\\xff", "camera ! continued"]
    assert all(re.fullmatch(f"{stamp} {text}", line) for text, line in zip(wanted, lines, strict=True)), lines


def test_a_log_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    for device in ("/dev/full", "/dev/null"):
        log = Log(Path(device))
        with pytest.raises(StorageError, match="is no regular file"):
            log.write("rotator", ">", "0gp")
        log.write("rotator", ">", "0gp")
    with pytest.raises(StorageError, match="cannot write"):
        Log(tmp_path / "nowhere" / "rig.log").write("rotator", ">", "0gp")
