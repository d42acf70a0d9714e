"""Virtual time, which passes only while the rig waits, and serial ports with a simulated device at the far end.

    with virtual.time(), Elliptec() as device:
        rotator = open_rotator(f"elliptec:{device.port}", Log(None))

Reading from such a port advances the clock, and the device with it. So no test waits, and none depends on the load of
the machine.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Protocol
from unittest import mock

import serial

from polcap.rig import (
    device_urls,
    motor_elliptec_ell14,
    motor_grbl,
    motor_line_protocol,
    rotator,
    serial_port,
)

_STEP_S = 0.002  # how often a device looks at its clock
_BITS = 10  # of a byte on the wire: start, eight, stop


class Clock:
    """Replaces the module `time` in the rig."""

    def __init__(self) -> None:
        self._now = 1000.0

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += seconds


CLOCK = Clock()


class FarEnd(Protocol):
    """A device, as seen from its cable."""

    delivered: bytes  # answers that came through the wire and were not read yet

    @property
    def gone(self) -> bool: ...

    def receive(self, data: bytes) -> None: ...

    def step(self) -> None:
        """Finish movements and deliver answers that are due."""


PLUGGED: dict[str, FarEnd] = {}  # by URL


class Serial:
    """pyserial's port, as far as `serial_port` uses it."""

    def __init__(self, device: FarEnd, baud: int, timeout_s: float) -> None:
        self._device, self._baud, self.timeout = device, baud, timeout_s

    def write(self, data: bytes) -> None:
        self._pass(len(data) * _BITS / self._baud)
        self._device.receive(data)
        self._device.step()

    def read(self, size: int) -> bytes:
        end = CLOCK.monotonic() + self.timeout
        while not self._device.delivered and CLOCK.monotonic() < end:
            self._pass(_STEP_S)
        data, self._device.delivered = self._device.delivered[:size], self._device.delivered[size:]
        return data

    def read_until(self, expected: bytes, size: int) -> bytes:
        end, data = CLOCK.monotonic() + self.timeout, b""
        while not data.endswith(expected) and len(data) < size and CLOCK.monotonic() < end:
            self._pass(0.0 if self._device.delivered else _STEP_S)
            data, self._device.delivered = data + self._device.delivered[:1], self._device.delivered[1:]
        return data

    def reset_input_buffer(self) -> None:
        self._pass(0.0)
        self._device.delivered = b""

    def close(self) -> None:
        """There is nothing to close."""

    def _pass(self, seconds: float) -> None:
        CLOCK.sleep(seconds)
        self._device.step()
        if self._device.gone:
            raise serial.SerialException("the cable was pulled")


_REAL = serial.serial_for_url


def _open(url: str, *, baudrate: int, timeout: float, **options: object) -> object:
    if url in PLUGGED:
        return Serial(PLUGGED[url], baudrate, timeout)
    return _REAL(url, baudrate=baudrate, timeout=timeout, **options)


@contextmanager
def time() -> Iterator[Clock]:
    """The rig's ports and motors use this clock."""
    with ExitStack() as patches:
        for module in (serial_port, motor_elliptec_ell14, motor_grbl, motor_line_protocol, rotator, device_urls):
            patches.enter_context(mock.patch.object(module, "time", CLOCK))
        patches.enter_context(mock.patch.object(serial, "serial_for_url", _open))
        yield CLOCK
