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
    """The far end of a pseudo-terminal."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.name = os.ttyname(self.slave)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def cut(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    with suppress(OSError):  # a test has cut it
        wire.cut()


def opened(url: str, log: Log | None = None) -> Port:
    return Port(url, 9600, log or Log(None))


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_port, "ANSWER_S", 0.2)


def test_lines_come_without_their_ends_and_empty_ones_are_passed_over() -> None:
    port = opened("loop://")
    port.send("\r\n0PO00000000\r\nok\n")
    assert [port.read_line(), port.read_line()] == ["0PO00000000", "ok"]


def test_no_answer_names_port_question_and_limit(wire: Wire) -> None:
    port = opened(wire.name)
    port.send("0gp")
    with pytest.raises(NoAnswer, match=re.escape(f"rotator on {wire.name} answered '0gp' with nothing within 0.2 s; ")):
        port.read_line()


def test_half_a_line_is_shown_and_does_not_join_the_next_answer(wire: Wire) -> None:
    port = opened(wire.name)
    port.send("0gp")
    wire.send(b"0PO00")
    with pytest.raises(NoAnswer, match="only '0PO00'"):
        port.read_line()
    wire.send(b"0GS00\r\n")
    assert port.read_line() == "0GS00"


def test_a_late_answer_is_not_taken_for_that_of_the_next_question(wire: Wire) -> None:
    port = opened(wire.name)
    port.send("0gp")
    wire.send(b"0PO00000001\r\n")
    assert port.read_line() == "0PO00000001"
    wire.send(b"0PO00000001\r\n")
    port.send("0gs")
    wire.send(b"0GS00\r\n")
    assert port.read_line() == "0GS00"


def test_bytes_that_are_not_text_are_no_answer(wire: Wire) -> None:
    port = opened(wire.name)
    port.send("0gp")
    wire.send(b"\xff\x00\x87~\r\n")
    with pytest.raises(NoAnswer, match="not text"):
        port.read_line()


def test_noise_without_an_end_is_given_up(wire: Wire) -> None:
    port = opened(wire.name)
    wire.send(b"x" * 2000)
    with pytest.raises(NoAnswer, match="only"):
        port.read_line(60)


def test_a_pulled_cable_is_unplugged_whether_reading_or_sending(wire: Wire) -> None:
    port = opened(wire.name)
    cut = threading.Timer(0.1, wire.cut)
    cut.start()
    with pytest.raises(Unplugged, match=f"{wire.name} is gone"):
        port.read_line(30)
    cut.join()
    for use in (lambda: port.send("0gp"), lambda: port.send("0gp", discard=False)):
        with pytest.raises(Unplugged):
            use()
    port.close()


def test_a_second_opener_is_refused(wire: Wire) -> None:
    first = opened(wire.name)
    with pytest.raises(HardwareError, match="another program holds it"):
        opened(wire.name)
    first.close()
    opened(wire.name).close()


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
        opened(url)


def test_a_socket_is_a_port_and_its_end_unplugs_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = opened(f"socket://127.0.0.1:{server.getsockname()[1]}")
        far, _ = server.accept()
        port.send("?\n")
        assert far.recv(10) == b"?\n"
        far.sendall(b"ok\n")
        assert port.read_line(30) == "ok"
        far.close()
        with pytest.raises(Unplugged):
            port.read_line(30)


def test_the_log_has_every_line_with_its_time(wire: Wire, tmp_path: Path) -> None:
    log = Log(tmp_path / "rig.log")
    port = opened(wire.name, log)
    port.send("0gp\r\n")
    wire.send(b"0PO00\xff\r\n")
    with pytest.raises(NoAnswer):
        port.read_line()
    lines = (tmp_path / "rig.log").read_text().splitlines()  # before it is closed
    stamp = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}"
    assert re.fullmatch(f"{stamp} rotator > 0gp", lines[0])
    assert re.fullmatch(rf"{stamp} rotator < 0PO00\\xff", lines[1])
    log.close()
    log.write("rotator", ">", "after the end")
    assert len((tmp_path / "rig.log").read_text().splitlines()) == 2


def test_a_log_is_continued(tmp_path: Path) -> None:
    for text in ("one", "two"):
        log = Log(tmp_path / "rig.log")
        log.write("camera", "!", text)
        log.close()
    assert [line.split()[-1] for line in (tmp_path / "rig.log").read_text().splitlines()] == ["one", "two"]


def test_a_full_disk_is_reported_once() -> None:
    log = Log(Path("/dev/full"))
    with pytest.raises(StorageError, match="the disk is full"):
        log.write("rotator", ">", "0gp")
    log.write("rotator", ">", "0gp")
    log.close()


def test_a_log_that_cannot_be_opened_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot write"):
        Log(tmp_path / "nowhere" / "rig.log").write("rotator", ">", "0gp")
