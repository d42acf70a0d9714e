"""Camera driver for `gphoto2`: a camera on a USB cable. Sets the exposure, releases, and fetches the RAW file.

Only this module imports gphoto2. Settings have the names of libgphoto2's drivers; a setting that the camera lacks is
skipped.
"""

import re
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from polcap.capture_values import Role
from polcap.errors import HardwareError, SettingError, package_for
from polcap.formats.raw import file_kind
from polcap.rig.camera import CameraFile
from polcap.rig.device_log import Log
from polcap.rig.exposure_bracket import Exposure, bracket_by_iso, bracket_by_shutter, nearest

T = TypeVar("T")

_WIDGETS = {  # by field of Exposure: names of the setting, and the power of its value that is proportional to light
    "time_s": (("shutterspeed", "shutterspeed2"), 1.0),
    "f_number": (("aperture", "f-number"), 2.0),
    "iso": (("iso",), 1.0),
    "flash": (("flashpower",), 1.0),
}
_FLASH_MODE = "flashmode"
_VALUE = re.compile(r"(?:f/?)?(?P<over>\d+(?:\.\d+)?/)?(?P<value>\d+(?:\.\d+)?) ?s?", re.IGNORECASE)
_REMEDY = {  # by error code of libgphoto2
    -7: "check the cable",
    -52: "plug it in, switch it on",
    -53: "another program uses it; close that program (gvfs, digiKam, …)",
    -105: "plug it in, switch it on, and set it to PTP",
    -110: "it is busy; wait, or switch it off and on",
    -115: "its card is full; put in another",
}
_SECOND_FILE_MS = 2000  # a camera that writes RAW and JPEG announces the second file within this time


class CallTimeout(HardwareError):
    """A call of libgphoto2 did not return. Its thread still runs, so the camera must not be used again."""


class Gphoto2Camera:
    """The camera on port `which` or with `which` in its model; the only one if `which` is empty."""

    frame_bytes = 60_000_000
    polarizes_flash = False

    def __init__(self, which: str, log: Log, timeout_s: float = 30.0) -> None:
        """`timeout_s` limits release and transfer, not counting the exposure. Raises HardwareError, SettingError."""
        self._gp = _gphoto2()
        self._log = log
        self._which = which
        self._timeout_s = timeout_s
        self._hangs = False
        self.model = "camera"
        self._camera: Any = self._ask("connect", self._connect)
        names = [*(name for names, _ in _WIDGETS.values() for name in names), _FLASH_MODE]
        self._choices = {name: self._ask(f"choices of {name}", partial(self._list_choices, name)) for name in names}
        modes = self._choices[_FLASH_MODE]
        self._flash_off = next((text for text in modes if "off" in text.lower()), None)
        self._flash_on = self._ask("flash mode", lambda: self._value(_FLASH_MODE)) if modes else None
        self.switches_flash = self._flash_off is not None

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """Default exposures: two stops around the camera's shutter speed; under a flash, steps of ISO."""
        name = self._widget("iso" if flash else "time_s")
        if flash:
            return bracket_by_iso([value for text in self._choices[name] if (value := _number(text))] if name else [])
        return bracket_by_shutter(_number(self._ask(f"value {name}", lambda: self._value(name))) if name else None)

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Nothing to do before a frame."""

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """Take one photograph. Reconnects once if the camera fails, but not if it hangs."""
        try:
            return self._shoot(exposure, flash)
        except CallTimeout:
            raise
        except HardwareError as error:
            self._log.write("camera", "!", f"{error}; connecting again")
            self.close()
            self._camera = self._ask("connect", self._connect)
            return self._shoot(exposure, flash)

    def close(self) -> None:
        if not self._hangs:
            with suppress(HardwareError):
                self._ask("disconnect", self._camera.exit)

    def _shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """Set exposure and flash, and take one photograph."""
        set_values = {field: self._set(field, getattr(exposure, field)) for field in _WIDGETS}
        if self._flash_off is not None and self._flash_on is not None:
            self._choose(_FLASH_MODE, self._flash_on if flash else self._flash_off)
        seconds = set_values["time_s"] or exposure.time_s or 0.0
        data, name = self._ask("capture", self._capture, seconds)
        return CameraFile(data, name, Exposure(**set_values))

    def _connect(self) -> Any:
        """Connect to the one camera that fits. Raises HardwareError: there is none; SettingError: there are several."""
        found = connected_cameras()
        fitting = [(name, port) for name, port in found if self._which.lower() in name.lower() or port == self._which]
        listed = ", ".join(f"{name} at {port}" for name, port in fitting or found) or "none"
        if not fitting:
            raise HardwareError(f"no camera {self._which or 'on any cable'} ({listed}); plug it in and switch it on")
        if len(fitting) > 1:
            raise SettingError(f"--camera gphoto2: there are {listed}; give gphoto2:PORT")
        self.model, port = fitting[0]
        ports = self._gp.PortInfoList()
        ports.load()
        camera = self._gp.Camera()
        camera.set_port_info(ports[ports.lookup_path(port)])
        camera.init()
        return camera

    def _set(self, field: str, wanted: float | None) -> float | None:
        """Set a camera setting to the value nearest in stops. Returns it, or None if the setting was not changed."""
        name = self._widget(field)
        if wanted is None or name is None:
            return None
        offered = {value: text for text in self._choices[name] if (value := _number(text))}
        value = nearest(field, wanted, list(offered), _WIDGETS[field][1])
        self._choose(name, offered[value])
        return value

    def _widget(self, field: str) -> str | None:
        """Name of the camera's setting for a field of Exposure; None if it has none that can be set."""
        return next((name for name in _WIDGETS[field][0] if self._choices[name]), None)

    def _list_choices(self, name: str) -> list[str]:
        """Values that a camera setting offers; none if the camera lacks the setting or it is read-only."""
        gp = self._gp
        try:
            widget = self._camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if error.code == gp.GP_ERROR_BAD_PARAMETERS:
                return []
            raise
        selectable = widget.get_type() in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU) and not widget.get_readonly()
        return [str(text) for text in widget.get_choices()] if selectable else []

    def _value(self, name: str) -> str:
        return str(self._camera.get_single_config(name).get_value())

    def _choose(self, name: str, text: str) -> None:
        """Set the camera setting `name` to one of its choices."""

        def choose() -> None:
            widget = self._camera.get_single_config(name)
            widget.set_value(text)
            self._camera.set_single_config(name, widget)

        self._ask(f"{name} = {text}", choose)

    def _capture(self) -> tuple[bytes, str]:
        """Release the shutter and fetch the RAW file; a JPEG only if the camera writes no RAW."""
        place = self._camera.capture(self._gp.GP_CAPTURE_IMAGE)
        data = self._fetch(place)
        while data.startswith(file_kind.JPEG):
            kind, content = self._camera.wait_for_event(_SECOND_FILE_MS)
            if kind == self._gp.GP_EVENT_TIMEOUT:
                break
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                place, data = content, self._fetch(content)
        return data, str(place.name)

    def _fetch(self, place: Any) -> bytes:
        file = self._camera.file_get(place.folder, place.name, self._gp.GP_FILE_TYPE_NORMAL)
        return bytes(memoryview(file.get_data_and_size()))

    def _ask(self, request: str, call: Callable[[], T], extra_s: float = 0.0) -> T:
        """Call a function of libgphoto2: logged, limited in time, any failure raised as a HardwareError of one line."""
        self._log.write("camera", ">", request)
        try:
            answer = call_within(self._timeout_s + extra_s, f"{self.model}: {request}", call)
        except CallTimeout:
            self._hangs = True
            raise
        except self._gp.GPhoto2Error as error:
            self._log.write("camera", "<", f"{error.code} {error.string}")
            remedy = _REMEDY.get(error.code, "check the cable, switch it off and on")
            raise HardwareError(f"{self.model}: {request}: {error.string} ({error.code}); {remedy}") from None
        text = f"{answer[1]}, {len(answer[0])} bytes" if isinstance(answer, tuple) else answer
        self._log.write("camera", "<", str(text) if isinstance(text, str | list) else "ok")
        return answer


def call_within(timeout_s: float, name: str, call: Callable[[], T]) -> T:
    """Run `call` in its own thread, so that Ctrl-C works meanwhile. Raises CallTimeout after `timeout_s`."""
    answer: Future[T] = Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=run, daemon=True, name=name).start()
    if not wait([answer], timeout_s).done:
        raise CallTimeout(f"{name} took more than {timeout_s:g} s; switch the device off and on, check its cable")
    return answer.result()


def connected_cameras() -> list[tuple[str, str]]:
    """Model and port of every connected camera. Raises HardwareError; SettingError without gphoto2."""
    gphoto2 = _gphoto2()
    try:
        found = gphoto2.Camera.autodetect()
        return [(str(found.get_name(at)), str(found.get_value(at))) for at in range(found.count())]
    except gphoto2.GPhoto2Error as error:
        raise HardwareError(f"cameras cannot be listed: {error.string} ({error.code}); check the cables") from None


def _gphoto2() -> Any:
    with package_for("a camera on a cable", "gphoto2", "rig"):
        import gphoto2
    return gphoto2


def _number(text: str) -> float | None:
    """Parse the text of a camera setting (1/200, 0.0050s, f/11, 100); None for Auto, bulb and the like."""
    match = _VALUE.fullmatch(text.strip().replace(",", "."))
    if match is None or not float(match["value"]):
        return None
    value = float(match["value"])
    return float(match["over"][:-1]) / value if match["over"] else value
