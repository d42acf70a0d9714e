"""In: a serial port's URL. Out: an exchange of lines whose every failure is one HardwareError, and in time.

URLs are pyserial's: `/dev/ttyUSB0`, `COM3`, `socket://host:port`, `loop://`. Alone knows pyserial.
"""

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

import serial
from serial.tools import list_ports

from polcap.errors import HardwareError, SettingError
from polcap.rig.log import Log

T = TypeVar("T")
_FAILURES: tuple[type[Exception], ...] = (OSError, TypeError)  # TypeError: pyserial, closed meanwhile
with suppress(ImportError):  # Windows
    import termios

    _FAILURES += (termios.error,)  # a pulled cable; neither SerialException nor OSError

ANSWER_S = 1.0  # for one answer
_SLICE_S = 0.05  # longest single read
_QUIET_S = 0.25  # after which nothing is on its way any more; a USB adapter delivers within 16 ms
_CATCH_UP_S = 2.0  # longest wait for that
_LONGEST_LINE = 1024  # bytes; more without a line's end is noise
_REFUSED = {
    errno.ENOENT: "there is no such port; plug the device in, `polcap doctor` lists the ports",
    errno.EACCES: "permission denied; add yourself to the port's group (dialout on Debian), log in again",
    errno.EBUSY: "another program holds it; close that program",
    errno.EAGAIN: "another program holds it; close that program",
    errno.ECONNREFUSED: "nothing listens there; start the serial server",
}


class Silent(HardwareError):
    """No answer, half of one, or one that means nothing; asking again may help."""


class Unplugged(HardwareError):
    """The port is gone."""


def patiently(ask: Callable[[], T]) -> T:
    """Ask a silent device up to three times."""
    for _ in range(2):
        with suppress(Silent):
            return ask()
    return ask()


def ports() -> list[tuple[str, str]]:
    """The serial ports of this machine and what the system calls them."""
    return sorted((port.device, port.description) for port in list_ports.comports())


def started(driver: Callable[["Port"], T], url: str, baud: int, log: Log) -> T:
    """A rotator's driver on a port of its own, which is closed again where the driver does not start.

    Raises
    ------
    HardwareError
        The port cannot be opened, or what answers there is not what the driver speaks to.
    """
    port = Port(url, baud=baud, log=log, name="rotator")
    try:
        return driver(port)
    except BaseException:
        port.close()
        raise


class Port:
    """Lines of ASCII over a port nobody else may open meanwhile."""

    def __init__(self, url: str, *, baud: int, log: Log, name: str) -> None:
        """Raises HardwareError where the port cannot be opened, SettingError where the URL is none."""
        self.url = url
        self._log = log
        self._name = name
        self._kept = b""  # received and not yet read
        self._asked = ""
        self._behind = self._heard = False  # a question has no answer yet; something came since
        try:
            self._serial = serial.serial_for_url(
                url, baudrate=baud, timeout=_SLICE_S, write_timeout=ANSWER_S, exclusive=True
            )
        except ValueError as error:
            raise SettingError(
                f"{url} is no serial port ({error}); give /dev/ttyUSB0, COM3 or socket://host:port"
            ) from None
        except _FAILURES as error:
            code = getattr(error, "errno", None) or getattr(error.__context__, "errno", None) or 0
            text = _REFUSED[errno.EBUSY] if "exclusively lock" in str(error) else _REFUSED.get(code, str(error))
            raise HardwareError(f"cannot open {url}: {text}") from error

    def send(self, data: bytes) -> None:
        """Forget what came before, and send. Raises Silent, Unplugged."""
        if self._behind:
            self._catch_up()
        self.drain()
        self.add(data)

    def add(self, data: bytes) -> None:
        """Send, and keep what has come but was not read. Raises Silent, Unplugged."""
        self._asked = shown(data)
        with self._clear():
            self._serial.write(data)
        self._log.write(self._name, ">", self._asked)

    def read_line(self, timeout_s: float | None = None) -> str:
        """The next line that is not empty, without its end.

        Raises
        ------
        Silent
            None came in time, half of one, or what is no ASCII.
        Unplugged
            The port is gone.
        """
        limit = ANSWER_S if timeout_s is None else timeout_s
        end = time.monotonic() + limit
        over = False
        while True:
            line, found, rest = self._kept.partition(b"\n")
            if found:
                self._kept = rest
                if line.strip():
                    return self._understood(line.strip())
                continue
            if over or len(self._kept) > _LONGEST_LINE:
                break
            over = time.monotonic() >= end  # a busy machine may look late: what has come by then counts
            with self._clear():
                waiting = self._serial.in_waiting
                if waiting or not over:
                    self._kept += self._serial.read(max(1, waiting))
        half, self._kept = self._kept, b""
        self._behind, self._heard = True, False
        if half.strip():
            self._log.write(self._name, "<", shown(half) + " …")
            raise Silent(
                f"{self.where} only '{shown(half):.40}' within {limit:.3g} s; check the cable and the baud rate"
            )
        raise Silent(f"{self.where} nothing within {limit:.3g} s; check the cable, the power and the URL")

    def drain(self) -> None:
        """Forget what has come and was not read. Raises Unplugged."""
        self._kept = b""
        with self._clear():
            self._serial.reset_input_buffer()

    def close(self) -> None:
        with suppress(*_FAILURES):
            self._serial.close()

    @property
    def where(self) -> str:
        """How a message about the last exchange begins."""
        return f"{self._name} on {self.url} answered '{self._asked}' with" if self._asked else f"{self.url} sent"

    def strange(self, line: str) -> Silent:
        """The error for an answer that means nothing."""
        return Silent(
            f"{self.where} '{line:.40}', which means nothing; check the cable and that the URL names this device"
        )

    def _understood(self, line: bytes) -> str:
        self._log.write(self._name, "<", shown(line))
        self._heard = True
        if not all(32 <= byte < 127 or byte == 9 for byte in line):
            raise Silent(f"{self.where} '{shown(line):.40}', which is no text; check the cable and the baud rate")
        return line.decode("ascii")

    def _catch_up(self) -> None:
        """Let answers to what was asked before arrive, lest they be taken for the next one's."""
        limit = time.monotonic() + _CATCH_UP_S
        quiet = time.monotonic() + _QUIET_S
        while time.monotonic() < min(quiet, limit):
            with self._clear():
                if self._serial.read(max(1, self._serial.in_waiting)):
                    self._heard, quiet = True, time.monotonic() + _QUIET_S
        self._behind = not self._heard

    @contextmanager
    def _clear(self) -> Iterator[None]:
        """One error for every way a port fails."""
        try:
            yield
        except serial.SerialTimeoutException as error:
            raise Silent(f"{self._name} on {self.url} takes no data; check its power") from error
        except _FAILURES as error:
            raise Unplugged(
                f"{self._name} on {self.url} is gone: unplugged, or without power; plug it in again"
            ) from error


def shown(data: bytes) -> str:
    """Bytes as a log line shows them: without the line's end, control characters escaped."""
    return repr(data.strip(b"\r\n"))[2:-1]
