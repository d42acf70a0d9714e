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
_LATE_S = 1.0  # an answer may be late by up to this
_LONGEST_LINE = 1024  # bytes; more without a line end is noise
_CANNOT_OPEN = {
    errno.ENOENT: "there is no such port; plug the device in, `polcap doctor` lists the ports",
    errno.EACCES: "permission denied; add yourself to the port's group (dialout on Debian), log in again",
    errno.EBUSY: "another program holds it; close that program",
    errno.EAGAIN: "another program holds it; close that program",
    errno.ECONNREFUSED: "nothing listens there; start the serial server",
}


class NoAnswer(HardwareError):
    """Error: the answer of a device is missing, incomplete or unknown; asking again may help."""


class Unplugged(HardwareError):
    """Error: the serial port has disappeared."""


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
                    time.sleep(_LATE_S)
                self._serial.reset_input_buffer()
                self._answer_missing = False
            self._serial.write(text.encode("ascii"))
        self._question = _printable(text.encode("ascii"))
        self.log.write("rotator", ">", self._question)

    def read_line(self, limit_s: float | None = None) -> str:
        """The next line that is not empty, without its end. Raises NoAnswer, Unplugged."""
        limit_s = ANSWER_S if limit_s is None else limit_s
        end, received = time.monotonic() + limit_s, b""
        with self._named_failures():
            while not received.endswith(b"\n") and len(received) < _LONGEST_LINE:
                late = time.monotonic() >= end  # a line that has arrived by now counts
                received = (received + self._serial.read_until(b"\n", _LONGEST_LINE)).lstrip(b"\r\n")
                if late:
                    break
        shown = _printable(received)
        if not received.endswith(b"\n"):
            self._answer_missing = True
            if not received:
                raise self._no_answer(f"nothing within {limit_s:.3g} s; check the cable, the power and the URL")
            self.log.write("rotator", "<", f"{shown} …")
            raise self._no_answer(f"only '{shown:.40}' within {limit_s:.3g} s; check the cable and the baud rate")
        self.log.write("rotator", "<", shown)
        line = received.strip()
        if not all(32 <= byte < 127 or byte == 9 for byte in line):
            raise self._no_answer(f"'{shown:.40}', which is not text; check the cable and the baud rate")
        return line.decode("ascii")

    def read_lines(self) -> Iterator[str]:
        """Yield the lines of one answer. Raises NoAnswer when the time for an answer is over, Unplugged."""
        end = time.monotonic() + ANSWER_S
        while True:
            yield self.read_line(max(0.0, end - time.monotonic()))

    def close(self) -> None:
        with suppress(*_FAILURES):
            self._serial.close()

    def unknown_answer(self, line: str) -> NoAnswer:
        """Make the error for a received line that is not an answer of the protocol."""
        return self._no_answer(f"'{line:.40}', an unknown answer; check the cable and that the URL names this device")

    def _no_answer(self, text: str) -> NoAnswer:
        asked = f"rotator on {self.url} answered '{self._question}' with" if self._question else f"{self.url} sent"
        return NoAnswer(f"{asked} {text}")

    @contextmanager
    def _named_failures(self) -> Iterator[None]:
        """Context manager: errors of pyserial become NoAnswer or Unplugged."""
        try:
            yield
        except serial.SerialTimeoutException as error:
            raise NoAnswer(f"rotator on {self.url} accepts no data; check its power") from error
        except _FAILURES as error:
            raise Unplugged(f"rotator on {self.url} is gone: unplugged, or without power; plug it in again") from error


def _printable(data: bytes) -> str:
    """Bytes as text for the log and for messages: without the line end, control characters escaped."""
    return repr(data.strip(b"\r\n"))[2:-1]
