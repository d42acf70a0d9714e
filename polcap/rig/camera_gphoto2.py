"""A camera on a cable, driven by libgphoto2: exposures in, its RAW files out, byte for byte.

Alone knows gphoto2. Settings are found by the names that libgphoto2's drivers give them; a body that lacks one is
used as it stands.
"""

import re
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from polcap.errors import HardwareError, SettingError
from polcap.images import Role
from polcap.rig import watchdog
from polcap.rig.camera import Exposure, Shot, by_iso, by_shutter, nearest
from polcap.rig.log import Log

T = TypeVar("T")

_WIDGETS = {  # of Exposure's fields, and the power of the value that is light
    "time_s": (("shutterspeed", "shutterspeed2"), 1.0),
    "f_number": (("aperture", "f-number"), 2.0),
    "iso": (("iso",), 1.0),
    "flash": (("flashpower",), 1.0),
}
_FLASH_MODE = "flashmode"
_VALUE = re.compile(r"(?:f/?)?(?P<over>\d+(?:\.\d+)?/)?(?P<value>\d+(?:\.\d+)?) ?s?", re.IGNORECASE)
_REMEDY = {
    -7: "check the cable",
    -52: "plug it in, switch it on",
    -53: "another program holds it; close that program (gvfs, digiKam, …)",
    -105: "plug it in, switch it on, and set it to PTP",
    -110: "it is busy; wait, or switch it off and on",
    -115: "its card is full; put in another",
}
_JPEG = b"\xff\xd8\xff"
_SECOND_FILE_MS = 2000  # a body that writes RAW and JPEG tells of the second this long after the first


class Gphoto2:
    """The camera whose model contains `which`, or on port `which`; the only one where it is empty."""

    frame_bytes = 60_000_000

    def __init__(self, which: str, log: Log, timeout_s: float = 30.0) -> None:
        """`timeout_s` is for a release and the transfer, beside the exposure. Raises HardwareError, SettingError."""
        try:
            import gphoto2
        except ModuleNotFoundError:
            raise SettingError("gphoto2 is not installed; pip install 'polcap[rig]'") from None
        self._gp: Any = gphoto2
        self._log = log
        self._which = which
        self._timeout_s = timeout_s
        self._busy = threading.Lock()  # held while a call is on its way
        self.model = "camera"
        self._camera: Any = self._ask("connect", self._connect)
        known = [name for names, _ in _WIDGETS.values() for name in names]
        self._choices = {
            name: self._ask(f"offer {name}", partial(self._offered, name)) for name in (*known, _FLASH_MODE)
        }
        self.switches_flash = self._dark() is not None
        self.polarizes_flash = False
        self._lit = self._ask("flash mode", lambda: self._value(_FLASH_MODE)) if self._choices[_FLASH_MODE] else None

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """Two stops darker and lighter than the camera's own shutter speed; under a flash by its ISO."""
        (names, _) = _WIDGETS["iso" if flash else "time_s"]
        name = self._widget(names)
        if flash:
            return by_iso([value for text in self._choices[name] if (value := _number(text))] if name else [])
        return by_shutter(_number(self._ask(f"value {name}", lambda: self._value(name))) if name else None)

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Nothing: the camera sees for itself."""

    def shoot(self, exposure: Exposure, flash: bool) -> Shot:
        """Connects anew once where the camera fails, but not where it hangs."""
        try:
            return self._shoot(exposure, flash)
        except watchdog.Stalled:
            raise
        except HardwareError as error:
            self._log.write("camera", "!", f"{error}; connecting again")
            with suppress(HardwareError):
                self._ask("disconnect", self._camera.exit)
            self._camera = self._ask("connect", self._connect)
            return self._shoot(exposure, flash)

    def close(self) -> None:
        if self._busy.acquire(timeout=self._timeout_s):  # else it hangs, and would again
            self._busy.release()
            with suppress(HardwareError):
                self._ask("disconnect", self._camera.exit)

    def _shoot(self, exposure: Exposure, flash: bool) -> Shot:
        done = {field: self._set(field, getattr(exposure, field)) for field in _WIDGETS}
        self._light(flash)
        seconds = done["time_s"] or exposure.time_s or 0.0
        data, name = self._ask("capture", self._capture, seconds)
        return Shot(data, name, Exposure(**done))

    def _connect(self) -> Any:
        gp = self._gp
        found = connected()
        fitting = [(name, port) for name, port in found if self._which.lower() in name.lower() or port == self._which]
        if not fitting:
            listed = ", ".join(f"{name} at {port}" for name, port in found) or "none"
            raise HardwareError(f"no camera {self._which or 'on any cable'} ({listed}); plug it in and switch it on")
        if len(fitting) > 1:
            listed = ", ".join(f"{name} at {port}" for name, port in fitting)
            raise SettingError(f"--camera gphoto2: there are {listed}; give gphoto2:PORT")
        self.model, port = fitting[0]
        ports = gp.PortInfoList()
        ports.load()
        camera = gp.Camera()
        camera.set_port_info(ports[ports.lookup_path(port)])
        camera.init()
        return camera

    def _set(self, field: str, asked: float | None) -> float | None:
        """Turn a dial to the value nearest in stops; returns it. None: the camera stays as it is."""
        names, power = _WIDGETS[field]
        name = self._widget(names)
        if asked is None or name is None:
            return None
        offered = {value: text for text in self._choices[name] if (value := _number(text))}
        value = nearest(field, asked, list(offered), power)
        self._ask(f"{name} = {offered[value]}", lambda: self._turn(name, offered[value]))
        return value

    def _light(self, flash: bool) -> None:
        dark = self._dark()
        if dark is not None and self._lit is not None:
            mode = self._lit if flash else dark
            self._ask(f"{_FLASH_MODE} = {mode}", lambda: self._turn(_FLASH_MODE, mode))

    def _dark(self) -> str | None:
        return next((text for text in self._choices[_FLASH_MODE] if "off" in text.lower()), None)

    def _widget(self, names: tuple[str, ...]) -> str | None:
        return next((name for name in names if self._choices[name]), None)

    def _offered(self, name: str) -> list[str]:
        """Choices of a setting; none where the body lacks it, or does not let it be chosen."""
        gp = self._gp
        try:
            widget = self._camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if error.code == gp.GP_ERROR_BAD_PARAMETERS:
                return []
            raise
        chosen = widget.get_type() in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU) and not widget.get_readonly()
        return [str(text) for text in widget.get_choices()] if chosen else []

    def _value(self, name: str) -> str:
        return str(self._camera.get_single_config(name).get_value())

    def _turn(self, name: str, text: str) -> None:
        widget = self._camera.get_single_config(name)
        widget.set_value(text)
        self._camera.set_single_config(name, widget)

    def _capture(self) -> tuple[bytes, str]:
        """Release, and fetch the RAW; the JPEG beside it only where there is nothing else."""
        place = self._camera.capture(self._gp.GP_CAPTURE_IMAGE)
        data = self._fetch(place)
        while data.startswith(_JPEG):
            kind, content = self._camera.wait_for_event(_SECOND_FILE_MS)
            if kind == self._gp.GP_EVENT_TIMEOUT:
                break
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                place, data = content, self._fetch(content)
        return data, str(place.name)

    def _fetch(self, place: Any) -> bytes:
        file = self._camera.file_get(place.folder, place.name, self._gp.GP_FILE_TYPE_NORMAL)
        return bytes(memoryview(file.get_data_and_size()))

    def _ask(self, what: str, call: Callable[[], T], extra_s: float = 0.0) -> T:
        """One exchange, logged, in time, its failure told in one line."""

        def run() -> T:
            with self._busy:
                return call()

        self._log.write("camera", ">", what)
        try:
            answer = watchdog.within(self._timeout_s + extra_s, f"{self.model}: {what}", run)
        except self._gp.GPhoto2Error as error:
            self._log.write("camera", "<", f"{error.code} {error.string}")
            remedy = _REMEDY.get(error.code, "check the cable, switch it off and on")
            raise HardwareError(f"{self.model}: {what}: {error.string} ({error.code}); {remedy}") from None
        self._log.write("camera", "<", _shown(answer))
        return answer


def connected() -> list[tuple[str, str]]:
    """Model and port of every camera on a cable. Raises HardwareError; SettingError without gphoto2."""
    try:
        import gphoto2
    except ModuleNotFoundError:
        raise SettingError("gphoto2 is not installed; pip install 'polcap[rig]'") from None
    try:
        found = gphoto2.Camera.autodetect()
        return [(str(found.get_name(at)), str(found.get_value(at))) for at in range(found.count())]
    except gphoto2.GPhoto2Error as error:
        raise HardwareError(f"cameras cannot be listed: {error.string} ({error.code}); check the cables") from None


def _number(text: str) -> float | None:
    """A dial's value: 1/200, 0.0050s, f/11, 100; None for Auto, bulb and the like."""
    match = _VALUE.fullmatch(text.strip().replace(",", "."))
    value = float(match["value"]) if match else 0.0
    if match is None or not value:
        return None
    return float(match["over"][:-1]) / value if match["over"] else value


def _shown(answer: object) -> str:
    if isinstance(answer, tuple):
        return f"{answer[1]}, {len(answer[0])} bytes"
    return str(answer) if isinstance(answer, str | list) else "ok"
