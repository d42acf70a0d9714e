"""Serial port with timeouts: lines of text out and in, and one HardwareError for every failure.

URLs are pyserial's: `/dev/ttyUSB0`, `COM3`, `socket://host:port`, `loop://`. Only this module imports pyserial.
"""

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

import serial
from serial.tools import list_ports

from polcap.errors import HardwareError, SettingError
from polcap.rig.device_log import Log

T = TypeVar("T")
_FAILURES: tuple[type[Exception], ...] = (OSError, TypeError)  # pyserial raises TypeError on a closed port
with suppress(ImportError):  # Windows
    import termios

    _FAILURES += (termios.error,)  # a pulled cable

ANSWER_S = 1.0  # time limit of one answer
_READ_S = 0.05  # pyserial's timeout; a new one for every read would configure the port again
_QUIET_S = 0.25  # after so long without a byte no answer is on its way; a USB adapter delivers within 16 ms
_LATE_S = 2.0  # longest wait for late answers
_LONGEST_LINE = 1024  # bytes; more without a line end is noise
_CANNOT_OPEN = {
    errno.ENOENT: "there is no such port; plug the device in, `polcap doctor` lists the ports",
    errno.EACCES: "permission denied; add yourself to the port's group (dialout on Debian), log in again",
    errno.EBUSY: "another program holds it; close that program",
    errno.EAGAIN: "another program holds it; close that program",
    errno.ECONNREFUSED: "nothing listens there; start the serial server",
}


class NoAnswer(HardwareError):
    """No answer, half of one, or an unknown one; asking again may help."""


class Unplugged(HardwareError):
    """The port has disappeared."""


def retry(ask: Callable[[], T]) -> T:
    """Ask a device up to three times while it does not answer."""
    for _ in range(2):
        with suppress(NoAnswer):
            return ask()
    return ask()


def serial_ports() -> list[tuple[str, str]]:
    """Device and description of this machine's serial ports."""
    return sorted((port.device, port.description) for port in list_ports.comports())


class Port:
    """An exclusively opened serial port for lines of ASCII."""

    def __init__(self, url: str, baud: int, log: Log) -> None:
        """Raises HardwareError if the port cannot be opened, SettingError for a malformed URL."""
        self.url = url
        self.log = log
        self._question = ""
        self._answer_missing = False  # it may still come, and must not be taken for the next answer
        self._heard = False  # something has come since
        try:
            self._serial = serial.serial_for_url(
                url, baudrate=baud, timeout=_READ_S, write_timeout=ANSWER_S, exclusive=True
            )
        except ValueError as error:
            raise SettingError(
                f"{url} is no serial port ({error}); give /dev/ttyUSB0, COM3 or socket://host:port"
            ) from None
        except _FAILURES as error:
            code = getattr(error, "errno", None) or getattr(error.__context__, "errno", None) or 0
            code = errno.EBUSY if "exclusively lock" in str(error) else code
            raise HardwareError(f"cannot open {url}: {_CANNOT_OPEN.get(code, error)}") from error

    def send(self, text: str, discard: bool = True) -> None:
        """Send `text`, by default after discarding all unread input. Raises NoAnswer, Unplugged."""
        with self._named_failures():
            if discard:
                if self._answer_missing:
                    self._discard_late_answers()
                self._serial.reset_input_buffer()
            self._serial.write(text.encode("ascii"))
        self._question = _printable(text.encode("ascii"))
        self.log.write("rotator", ">", self._question)

    def read_line(self, limit_s: float | None = None) -> str:
        """The next line that is not empty, without its end. Raises NoAnswer, Unplugged."""
        limit_s = ANSWER_S if limit_s is None else limit_s
        end = time.monotonic() + limit_s
        received, over = b"", False
        with self._named_failures():
            while not over and not received.endswith(b"\n") and len(received) < _LONGEST_LINE:
                over = time.monotonic() >= end  # read once more: a line that has arrived by now counts
                received += self._serial.read_until(b"\n", _LONGEST_LINE)
                if received.endswith(b"\n") and not received.strip():
                    received = b""
        line = received.strip()
        if received.endswith(b"\n"):
            return self._decoded(line)
        self._answer_missing, self._heard = True, False
        if line:
            self.log.write("rotator", "<", _printable(line) + " …")
            raise NoAnswer(
                f"{self._subject} only '{_printable(line):.40}' within {limit_s:.3g} s; "
                "check the cable and the baud rate"
            )
        raise NoAnswer(f"{self._subject} nothing within {limit_s:.3g} s; check the cable, the power and the URL")

    def read_lines(self, limit_s: float | None = None) -> Iterator[str]:
        """Lines as they come. Raises NoAnswer when the time is over, Unplugged."""
        end = time.monotonic() + (ANSWER_S if limit_s is None else limit_s)
        while True:
            yield self.read_line(max(0.0, end - time.monotonic()))

    def close(self) -> None:
        with suppress(*_FAILURES):
            self._serial.close()

    def unknown_answer(self, line: str) -> NoAnswer:
        """The error for a line that is no answer of the protocol."""
        return NoAnswer(
            f"{self._subject} '{line:.40}', an unknown answer; check the cable and that the URL names this device"
        )

    @property
    def _subject(self) -> str:
        return f"rotator on {self.url} answered '{self._question}' with" if self._question else f"{self.url} sent"

    def _decoded(self, line: bytes) -> str:
        self.log.write("rotator", "<", _printable(line))
        self._heard = True
        if not all(32 <= byte < 127 or byte == 9 for byte in line):
            raise NoAnswer(
                f"{self._subject} '{_printable(line):.40}', which is not text; check the cable and the baud rate"
            )
        return line.decode("ascii")

    def _discard_late_answers(self) -> None:
        end = time.monotonic() + _LATE_S
        quiet = time.monotonic() + _QUIET_S
        while time.monotonic() < min(quiet, end):
            if self._serial.read(_LONGEST_LINE):
                self._heard, quiet = True, time.monotonic() + _QUIET_S
        self._answer_missing = not self._heard

    @contextmanager
    def _named_failures(self) -> Iterator[None]:
        try:
            yield
        except serial.SerialTimeoutException as error:
            raise NoAnswer(f"rotator on {self.url} accepts no data; check its power") from error
        except _FAILURES as error:
            raise Unplugged(f"rotator on {self.url} is gone: unplugged, or without power; plug it in again") from error


def _printable(data: bytes) -> str:
    """Bytes for the log and for messages: without the line end, control characters escaped."""
    return repr(data.strip(b"\r\n"))[2:-1]
