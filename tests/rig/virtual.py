"""Virtual time, which passes only while the rig waits, and serial ports with a simulated device at the far end.

Reading from such a port advances the clock, and the device with it. So no test waits, and none depends on the load of
the machine.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import serial

from polcap.rig import device_urls, motor_elliptec_ell14, motor_grbl, motor_line_protocol, rotator, serial_port
from tests.clocks import SleepClock

_STEP_S = 0.002  # between two steps of a device
_BITS = 10  # of a byte on the wire: start, eight, stop
_MODULES = (serial_port, motor_elliptec_ell14, motor_grbl, motor_line_protocol, rotator, device_urls)


CLOCK = SleepClock()
PLUGGED: dict[str, Any] = {}  # devices of `far_end` by URL


class Serial:
    """The methods of pyserial's port that `serial_port` uses."""

    def __init__(self, device: Any, baud: int, timeout_s: float) -> None:
        self._device, self._baud, self._timeout_s = device, baud, timeout_s

    def write(self, data: bytes) -> None:
        self._pass(len(data) * _BITS / self._baud)
        self._device.receive(data)
        self._device.step()

    def read_until(self, expected: bytes, size: int) -> bytes:
        end, data = CLOCK.monotonic() + self._timeout_s, b""
        while not data.endswith(expected) and len(data) < size and CLOCK.monotonic() < end:
            self._pass(0.0 if self._device.delivered else _STEP_S)
            data, self._device.delivered = data + self._device.delivered[:1], self._device.delivered[1:]
        return data

    def reset_input_buffer(self) -> None:
        self._pass(0.0)
        self._device.delivered = b""

    def close(self) -> None: ...

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
def time() -> Iterator[SleepClock]:
    """The rig's ports and motors use this clock."""
    with ExitStack() as patches:
        for module in _MODULES:
            patches.enter_context(mock.patch.object(module, "time", CLOCK))
        patches.enter_context(mock.patch.object(serial, "serial_for_url", _open))
        yield CLOCK
