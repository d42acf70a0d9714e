"""Opens the rotator or the camera that a URL names, such as `elliptec:/dev/ttyUSB0?address=0&offset=12`."""

import time
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from polcap.errors import SettingError
from polcap.rig import camera_gphoto2, camera_watch_folder, motor_by_hand, motor_elliptec_ell14, motor_grbl
from polcap.rig import motor_line_protocol as motor_line
from polcap.rig.camera import Camera
from polcap.rig.device_log import Log
from polcap.rig.motor_elliptec_ell14 import ElliptecMotor, ElliptecSettings
from polcap.rig.motor_grbl import GrblMotor, GrblSettings
from polcap.rig.motor_line_protocol import LineMotor, LineSettings
from polcap.rig.motor_simulated import SimulatedMotor, SimulatedMotorSettings
from polcap.rig.rotator import PolarizerRotator
from polcap.rig.serial_port import NoAnswer, Port, retry

_MOTORS: dict[str, tuple[Any, Any]] = {
    "elliptec": (ElliptecMotor, ElliptecSettings),
    "grbl": (GrblMotor, GrblSettings),
    "line": (LineMotor, LineSettings),
    "simulated": (SimulatedMotor, SimulatedMotorSettings),
}
_WITHOUT_PORT = ("simulated", "manual")
_QUESTIONS: list[tuple[int, str, float, tuple[Callable[[str], str | None], ...]]] = [
    # baud, question, time limit [s], recognizers of the devices that may answer
    (ElliptecMotor.baud, "0in", 0.5, (motor_elliptec_ell14.recognize,)),
    (GrblMotor.baud, "\n?\n", 3.0, (motor_grbl.recognize, motor_line.recognize)),
]


def open_rotator(url: str, log: Log, part: str = "polarizer") -> PolarizerRotator:
    """Open the rotator of a URL: `KIND:PORT?setting=value&…`, `simulated?…` or `manual`; it turns `part`.

    Raises SettingError for a wrong URL, HardwareError if the port cannot be opened or another device answers.
    """
    head, _, query = url.partition("?")
    kind, _, address = head.partition(":")
    if kind not in (*_MOTORS, "manual"):
        raise SettingError(f"rotator {url!r}: unknown kind; choose one of {', '.join(_MOTORS)}, manual")
    if kind in _WITHOUT_PORT and address:
        raise SettingError(f"rotator {url!r}: {kind} takes no port; write {kind}")
    if kind == "manual":
        if query:
            raise SettingError(f"rotator {url!r}: manual takes no settings; write manual")
        return PolarizerRotator(motor_by_hand.MotorByHand(log, part), motor_by_hand.SETTINGS, log, by_hand=True)
    motor_class, settings_class = _MOTORS[kind]
    settings = _settings(url, query, settings_class)
    if kind == "simulated":
        return PolarizerRotator(motor_class(settings, log), settings, log)
    if not address:
        examples = f"{kind}:/dev/ttyUSB0, {kind}:COM3 or {kind}:socket://…"
        raise SettingError(f"rotator {url!r} names no port; write {examples}")
    port = Port(address, motor_class.baud, log)
    try:
        return PolarizerRotator(retry(lambda: motor_class(port, settings)), settings, log, port)
    except BaseException:
        port.close()
        raise


def open_camera(name: str, log: Log) -> Camera:
    """Open the camera of a name: `gphoto2`, `gphoto2:MODEL or PORT`, `folder:PATH` or `simulated?width=768`.

    Raises SettingError for an unknown camera or setting, HardwareError if the camera does not answer.
    """
    kind, _, rest = name.partition(":")
    if kind == "gphoto2":
        return camera_gphoto2.Gphoto2Camera(rest, log)
    if kind == "folder" and rest:
        return camera_watch_folder.WatchFolderCamera(rest, log)
    if name.partition("?")[0] == "simulated":
        from polcap.rig import camera_simulated  # here: its renderer is slow to import

        return camera_simulated.SimulatedCamera(name.partition("?")[2], log)
    raise SettingError(f"--camera {name}: no such camera; give gphoto2, gphoto2:MODEL, folder:PATH or simulated")


def probe(port_url: str) -> str | None:
    """Ask for the rotator on a serial port: its name, or None if none answers within four seconds. Nothing moves.

    Opening the port restarts many Arduinos, which then send their name without a request.

    Raises HardwareError if the port cannot be opened.
    """
    for baud, question, limit_s, recognizers in _QUESTIONS:
        with closing(Port(port_url, baud, Log(None))) as port:
            end = time.monotonic() + limit_s
            with suppress(NoAnswer):
                port.send(question)
            while (left := end - time.monotonic()) > 0:
                with suppress(NoAnswer):
                    line = port.read_line(left)
                    if name := next(filter(None, (recognize(line) for recognize in recognizers)), None):
                        return name
    return None


def _settings(url: str, query: str, settings_class: type[msgspec.Struct]) -> Any:
    """Parse the settings in a device URL. Raises SettingError."""
    names = settings_class.__struct_fields__
    try:
        pairs = parse_qsl(query.replace("+", "%2B"), keep_blank_values=True, strict_parsing=bool(query))
        for key, _ in pairs:
            if key not in names:
                raise SettingError(f"rotator {url!r}: unknown setting {key!r}; the settings are {', '.join(names)}")
        return msgspec.convert({key: text.removeprefix("+") for key, text in pairs}, settings_class, strict=False)
    except msgspec.ValidationError as error:
        raise SettingError(f"rotator {url!r}: wrong setting: {error}; see docs/reference/rotators.md") from None
    except ValueError as error:
        raise SettingError(f"rotator {url!r}: {error}; write settings as ?offset=12&settle=0.5") from None
