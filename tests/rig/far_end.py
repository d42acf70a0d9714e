"""The base of all simulated rotators: a ring that takes time to turn, delayed answers, planted faults.

    with virtual.time(), Elliptec(fault="half-line", at=3) as device:
        rotator = open_rotator(f"elliptec:{device.port}", Log(None))

They use the clock of `virtual` and run while their port is read. With `real=True` they run in a thread on a
pseudo-terminal, for another process.

`fault` is one of the class's FAULTS or `late`; `at` is the first moment at which it strikes, `times` the number of
moments (`ALWAYS`: all). The first moment is 1.

    moments are answers:    no-answer, garbage, half-line, late (after `serial_port` has stopped waiting)
    moments are movements:  busy (never ends), mechanical-timeout, wrong-position (stops 5° away, and reports that);
    (homing is one)         halfway: unplug (the port vanishes), alarm (a limit switch), restart (power lost)
"""

import os
import select
import threading
import time
import tty
from collections.abc import Callable
from typing import Any, ClassVar, Self

from polcap.rig import serial_port
from tests.rig import virtual

ALWAYS = 1 << 30
SPOKEN = ("no-answer", "garbage", "half-line")
_LATENCY_S = 0.016  # of a USB adapter's buffer, for each answer
_LATE_S = 1.4 * serial_port.ANSWER_S
_OFF_DEG = 5.0  # of a wrong position


class Device:
    """A ring that takes time to turn, and answers that come one after the other."""

    FAULTS: ClassVar[tuple[str, ...]] = ()
    END = b"\r\n"

    def __init__(
        self, *, fault: str = "", at: int = 1, times: int = 1, speed_deg_s: float = 2000.0, start_deg: float = 37.0,
        real: bool = False,
    ) -> None:  # fmt: skip
        assert not fault or fault in (*self.FAULTS, "late"), f"{fault} is none of {self.FAULTS}"
        self.fault, self.struck_moments = fault, range(at, at + times)
        self.speed_deg_s = speed_deg_s
        self.angle_deg = start_deg  # true angle of the ring
        self.heard: list[str] = []  # commands
        self.moves = self.answers = 0
        self.delivered = b""  # answers that came through the wire and were not read yet
        self.gone = False  # the cable was pulled
        self.port = f"virtual://{id(self)}"
        self._clock: Any = time if real else virtual.CLOCK
        self._target_deg = start_deg
        self._struck = ""  # the fault of this movement
        self._ends: float | None = None  # monotonic time; None: the ring does not turn
        self._then: Callable[[], None] = lambda: None
        self._wire: list[tuple[float, bytes]] = []  # answers on their way, and when they arrive
        self._thread = threading.Thread(target=self._serve, daemon=True) if real else None
        if real:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self.port = os.ttyname(self._slave)

    def __enter__(self) -> Self:
        if self._thread:
            self._thread.start()
        else:
            virtual.PLUGGED[self.port] = self
        return self

    def __exit__(self, *_: object) -> None:
        self.gone = True
        virtual.PLUGGED.pop(self.port, None)
        if self._thread:
            self._thread.join(5)

    def receive(self, data: bytes) -> None:
        """Handle bytes that were sent to the device."""
        raise NotImplementedError

    def halfway(self) -> None:
        """The planted fault of a movement strikes: mechanical-timeout, alarm, restart."""
        raise NotImplementedError

    def tick(self) -> None:
        """Called every few milliseconds."""

    def say(self, text: str) -> None:
        """Answer a line, unless a fault is due."""
        self.answers += 1
        data, late_s = text.encode() + self.END, 0.0
        if self.answers in self.struck_moments:
            spoilt = {"no-answer": b"", "garbage": b"\xff\x00\x87~\xf3" + self.END, "half-line": data[: len(text) // 2]}
            data = spoilt.get(self.fault, data)
            late_s = _LATE_S if self.fault == "late" else 0.0
        self.send(data, late_s)

    def send(self, data: bytes, late_s: float = 0.0) -> None:
        """Put bytes on the wire, after those already on it."""
        before = max((due for due, _ in self._wire), default=0.0)
        self._wire.append((max(self._clock.monotonic() + late_s, before) + _LATENCY_S, data))

    @property
    def moving(self) -> bool:
        return self._ends is not None

    def turn(self, target_deg: float, then: Callable[[], None]) -> None:
        """Start turning; call `then` when the ring has stopped."""
        self.moves += 1
        due = self.fault not in (*SPOKEN, "late") and self.moves in self.struck_moments
        self._struck = self.fault if due else ""
        seconds = abs(target_deg - self.angle_deg) / self.speed_deg_s
        if self._struck == "wrong-position":
            target_deg += _OFF_DEG
        elif self._struck:
            target_deg, seconds = (target_deg + self.angle_deg) / 2, seconds / 2
        self._target_deg, self._then = target_deg, then
        self._ends = self._clock.monotonic() + seconds

    def freeze(self) -> None:
        """Stop at the present angle, without calling `then`."""
        if self._ends is not None:
            left = max(0.0, self._ends - self._clock.monotonic()) * self.speed_deg_s
            away = self._target_deg - self.angle_deg
            self.angle_deg = self._target_deg - (left if away > 0 else -left) if abs(away) > left else self.angle_deg
        self._ends = None

    def step(self) -> None:
        """Finish movements and deliver answers that are due."""
        self.tick()
        now = self._clock.monotonic()
        if self._ends is not None and now >= self._ends:
            self.angle_deg = self._target_deg
            self._ends = float("inf") if self._struck == "busy" else None
            if self._struck == "unplug":
                self.gone = True
            elif self._struck in ("mechanical-timeout", "alarm", "restart"):
                self.halfway()
            elif self._struck != "busy":
                self._then()
        while self._wire and self._wire[0][0] <= now:
            self.delivered += self._wire.pop(0)[1]

    def _serve(self) -> None:
        """Answer on the pseudo-terminal until the cable is pulled."""
        while not self.gone:
            if select.select([self._master], [], [], 0.002 if self.moving else 0.02)[0]:
                self.receive(os.read(self._master, 4096))
            self.step()
            os.write(self._master, self.delivered)
            self.delivered = b""
        os.close(self._master)
        os.close(self._slave)
