"""In: a URL as `elliptec:/dev/ttyUSB0?address=0&offset=12`. Out: a Rotator, which turns the polarizer and proves it.

What all motors share lives here: zero offset and sense of turning, approach from one side, settling, reading back,
asking a silent device again. A motor itself is a small driver (`elliptec`, `grbl`, `line_protocol`, `simulated`).
"""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any, Protocol, TypeVar
from urllib.parse import parse_qsl

import msgspec
from msgspec import Meta, Struct

from polcap.errors import HardwareError, PolcapError, SettingError
from polcap.rig import elliptec, grbl, line_protocol, manual
from polcap.rig.log import Log
from polcap.rig.serial_port import Port, Silent, Unplugged, patiently

T = TypeVar("T")

_Names = tuple[Callable[[str], str | None], ...]
_QUESTIONS: tuple[tuple[int, bytes, float, _Names], ...] = (  # baud, question, s, whose answer it may be
    (elliptec.BAUD, b"0in", 0.5, (elliptec.recognize,)),
    (grbl.BAUD, b"\n?\n", 3.0, (grbl.recognize, line_protocol.recognize)),
)
_APPROACHES = 2  # a wrong position is approached once more


def _simulated() -> Any:
    from polcap.rig import simulated  # here: it is heavy

    return simulated


MOTORS: dict[str, Callable[[], Any]] = {  # by URL; each a module with Settings, BACKLASH_DEG, open_motor
    "elliptec": lambda: elliptec,
    "grbl": lambda: grbl,
    "line": lambda: line_protocol,
    "simulated": _simulated,
}


class Rotator(Protocol):
    """What turns the polarizer."""

    model: str
    speed_deg_s: float
    settle_s: float
    unattended: bool  # False: a person turns it

    def home(self) -> None:
        """Find zero."""

    def move(self, angle_deg: float) -> float:
        """Turn the polarizer's axis there; returns the angle read back, in [0, 360). Raises HardwareError."""

    def stop(self) -> None:
        """Halt and release; never raises."""

    def close(self) -> None:
        """Stop, and give the port back; never raises."""


class Motor(Protocol):
    """What a driver offers, in the motor's own degrees."""

    model: str
    speed_deg_s: float
    wraps: bool  # positions are modulo 360

    def home(self) -> None: ...

    def go(self, angle_deg: float) -> None:
        """Turn there; returns when the motor stands."""

    def where(self) -> float:
        """The position the device reports."""

    def halt(self) -> None:
        """Stop turning and release."""

    def close(self) -> None: ...


class Drive(Struct, frozen=True):
    """Settings of every motor's URL."""

    offset: float = 0.0  # degrees; the motor's position where the polarizer's axis is at 0°
    reverse: bool = False  # the motor's degrees run clockwise, as the photographer sees the picture
    backlash: Annotated[float, Meta(ge=0, le=45)] | None = None  # degrees; the last stretch, always upwards
    settle: Annotated[float, Meta(ge=0, le=60)] = 0.2  # s
    tolerance: Annotated[float, Meta(gt=0, le=45)] = 0.3  # degrees
    timeout: Annotated[float, Meta(gt=0, le=600)] = 30.0  # s; the longest movement


def open_rotator(url: str, log: Log) -> Rotator:
    """The rotator a URL names.

    Raises
    ------
    SettingError
        The URL.
    HardwareError
        What should be there is not.
    """
    head, _, query = url.partition("?")
    kind, _, port = head.partition(":")
    stated = _pairs(url, query)
    if kind == "manual":
        if port or stated:
            raise SettingError(f"rotator {url!r}: manual takes no port and no settings; write manual")
        return manual.Manual(log)
    if kind not in MOTORS:
        raise SettingError(f"rotator {url!r}: {kind!r} is no rotator; choose one of {', '.join(MOTORS)}, manual")
    driver = MOTORS[kind]()
    shared, own = Drive.__struct_fields__, driver.Settings.__struct_fields__
    for key in stated:
        if key not in shared + own:
            raise SettingError(f"rotator {url!r}: {key!r} is no setting of {kind}; it knows {', '.join(own + shared)}")
    drive = _convert(url, {key: text for key, text in stated.items() if key in shared}, Drive)
    settings = _convert(url, {key: text for key, text in stated.items() if key in own}, driver.Settings)
    if not port and kind != "simulated":
        raise SettingError(
            f"rotator {url!r} names no port; write {kind}:/dev/ttyUSB0, {kind}:COM3 or {kind}:socket://…"
        )
    motor: Motor = driver.open_motor(port, settings, drive.timeout, log)
    return Driven(motor, drive, driver.BACKLASH_DEG if drive.backlash is None else drive.backlash, log)


def probe(url: str) -> str | None:
    """What answers on a serial port, within four seconds; asks for names only, and nothing moves.

    Opening its port restarts many an Arduino, which then tells its name by itself.

    Raises
    ------
    HardwareError
        The port cannot be opened.
    """
    for baud, question, limit_s, names in _QUESTIONS:
        port = Port(url, baud=baud, log=Log(None), name="port")
        try:
            port.send(question)
            end = time.monotonic() + limit_s
            while (left := end - time.monotonic()) > 0:
                with suppress(Silent):
                    said = port.read_line(left)
                    for recognize in names:
                        if name := recognize(said):
                            return name
        finally:
            port.close()
    return None


class Driven:
    """A motor made a rotator."""

    unattended = True

    def __init__(self, motor: Motor, drive: Drive, backlash_deg: float, log: Log) -> None:
        self.model = motor.model
        self.speed_deg_s = motor.speed_deg_s
        self.settle_s = drive.settle
        self._motor = motor
        self._drive = drive
        self._backlash_deg = backlash_deg
        self._log = log
        self._homed = False
        self._at: float | None = None  # where it was left, coming from below; motor degrees

    def home(self) -> None:
        self._at = None
        patiently(self._motor.home)
        self._homed = True

    def move(self, angle_deg: float) -> float:
        if not self._homed or self._lost():
            self.home()
        target = self._drive.offset + (-angle_deg if self._drive.reverse else angle_deg)
        if self._motor.wraps:
            target %= 360.0
        off = 0.0
        for _ in range(_APPROACHES):
            self._approach(target)
            time.sleep(self._drive.settle)
            off = _signed(patiently(self._motor.where) - target)
            if abs(off) <= self._drive.tolerance:
                self._at = target
                return _unsigned(angle_deg + (-off if self._drive.reverse else off))
        raise HardwareError(
            f"{self.model} stands {off:+.2f}° off {angle_deg:g}°, more than tolerance = {self._drive.tolerance:g}°; "
            "free the ring, check the mount, or raise tolerance in the rotator's URL"
        )

    def _lost(self) -> bool:
        """Whether it no longer stands where it was left: restarted, locked, or turned by hand."""
        if self._at is None:
            return False
        try:
            away = _signed(patiently(self._motor.where) - self._at)
            if abs(away) <= self._drive.tolerance:
                return False
            reason = f"stands {away:+.2f}° off where it was left"
        except (Silent, Unplugged):
            raise
        except HardwareError as error:
            reason = str(error)
        self._log.write("rotator", "!", f"{reason}; homed again")
        return True

    def _approach(self, target: float) -> None:
        """Turn to motor degrees, the last stretch upwards."""
        previous, self._at = self._at, None
        if self._backlash_deg and (previous is None or target < previous):
            below = target - self._backlash_deg
            patiently(lambda: self._motor.go(below))
        patiently(lambda: self._motor.go(target))

    def stop(self) -> None:
        self._homed = False  # released, the ring may be turned by hand
        with suppress(PolcapError):
            self._motor.halt()

    def close(self) -> None:
        self.stop()
        self._motor.close()


def _signed(angle_deg: float) -> float:
    """The same angle in [-180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _unsigned(angle_deg: float) -> float:
    """The same angle in [0, 360); the second modulo turns the 360 that rounding leaves into 0."""
    return angle_deg % 360.0 % 360.0


def _pairs(url: str, query: str) -> dict[str, str]:
    try:
        pairs = parse_qsl(query.replace("+", "%2B"), keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise SettingError(f"rotator {url!r}: {error}; write settings as ?offset=12&settle=0.5") from None
    return {key: text.removeprefix("+") for key, text in pairs}


def _convert(url: str, stated: dict[str, str], settings: type[T]) -> T:
    try:
        return msgspec.convert(stated, settings, strict=False)
    except msgspec.ValidationError as error:
        raise SettingError(f"rotator {url!r}: {error}; see the reference page on rotators") from None
