"""Reads capture.toml, the facts that a user states about a capture; a misspelt key is an error."""

import os
import unicodedata
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from polcap.capture_values import CatalogEntry, Role
from polcap.errors import CaptureError
from polcap.formats import text_file

NAME = "capture.toml"
Positive = Annotated[float, Meta(gt=0)]


class FrameEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """One photograph as listed in capture.toml: file (relative to the folder), role, angle [°], exposure [s]."""

    file: str
    angle: Annotated[float, Meta(ge=-360, le=360)] | None = None  # degrees; of shots and repeats
    role: Role = "shot"
    exposure: Positive | None = None  # relative, any unit; instead of EXIF
    flash_energy: Positive | None = None  # relative; the exposure is this times ISO/100 over the f-number squared


class Rotator(Struct, frozen=True, forbid_unknown_fields=True):
    """The device that turned the polarizer, as stated in capture.toml; only shown in the notes."""

    model: str = ""
    log: str = ""  # file of the angles reached, in the same folder


class CaptureFile(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of capture.toml; every key is optional."""

    name: Annotated[str, Meta(pattern=r"^[^/\\]+$")] = ""
    focal_length_mm: Positive | None = None
    sensor_width_mm: Positive | None = None  # of the visible pixels
    clockwise: bool = False  # angles count clockwise in the picture
    sensor: Literal["polarization"] | None = None  # every frame is the mosaic of such a sensor
    cells: tuple[tuple[float, float], tuple[float, float]] | None = None  # angles [°] of that mosaic's 2×2 cell
    encoding: Literal["linear", "srgb"] | None = None  # of finished pictures; by default 8 bits are sRGB
    white: Positive | None = None  # stored value at which linear pictures saturate; by default the type's largest
    black: Annotated[float, Meta(ge=0)] = 0.0  # stored value of darkness, linear pictures
    filter: str | None = None  # the polarizer's name, as in `polcap calibrate --filter`
    rotator: Rotator | None = None
    catalog: CatalogEntry = CatalogEntry()
    frame: tuple[FrameEntry, ...] = ()

    @property
    def of_sensor(self) -> bool:
        """Whether the frames are stated to be those of a polarization sensor."""
        return self.sensor is not None or self.cells is not None


def load(folder: Path) -> CaptureFile:
    """Read capture.toml of a capture folder; empty values if there is no such file. Raises CaptureError."""
    path = folder / NAME
    if not os.path.lexists(path):
        return CaptureFile()
    document: dict[str, Any] = {}
    try:
        document = text_file.read_toml(path)
        stated = msgspec.convert(document, CaptureFile)
    except msgspec.ValidationError as error:
        fault = text_file.fault(error, document, CaptureFile)
        if facts := [key for key in document if key in CatalogEntry.__struct_fields__]:
            fault = f"{facts[0]}: is a fact of the catalog; write it below a line [catalog], after all other keys"
        raise CaptureError(f"{path}: {fault}; see docs/reference/captures.md") from None
    except ValueError as error:  # of TOML, of UTF-8
        raise CaptureError(f"{path}: {error}; see docs/reference/captures.md") from None
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if stated.cells is not None and {angle % 180 for row in stated.cells for angle in row} != {0, 45, 90, 135}:
        raise CaptureError(
            f"{path}: cells = {list(map(list, stated.cells))}; give the angles of the sensor's 2×2 cell, row by row: "
            "0, 45, 90 and 135 degrees, such as [[90, 45], [135, 0]]"
        )
    for entry in stated.frame:
        if entry.role in ("shot", "repeat") and entry.angle is None and not stated.of_sensor:
            raise CaptureError(f"{path}: {entry.file} has role {entry.role} and no angle; give its angle in degrees")
        if entry.exposure and entry.flash_energy:
            raise CaptureError(f"{path}: {entry.file} states both exposure and flash_energy; give one of them")
    if stated.rotator and stated.rotator.log and not locate(folder, stated.rotator.log).is_file():
        raise CaptureError(f"{path}: no rotator log {stated.rotator.log}; correct or remove the line")
    return stated


def locate(folder: Path, name: str) -> Path:
    """Path of a file that capture.toml names; it may not exist.

    Backslashes are separators, as on Windows; a name in another Unicode form, as of macOS, is found.

    Raises CaptureError: the file lies outside the folder.
    """
    if not os.path.exists(folder / name):
        name = name.replace("\\", "/")
    if not Path(os.path.abspath(folder / name)).is_relative_to(os.path.abspath(folder)):
        raise CaptureError(f"{folder / NAME}: {name} lies outside the folder; move it inside")
    place = folder
    for part in PurePath(name).parts:
        place = place / part if os.path.exists(place / part) else _in_other_form(place, part)
    return place


def _in_other_form(folder: Path, name: str) -> Path:
    """Path of the file or folder whose name has the same characters, composed or decomposed; else of `name` itself."""
    form = unicodedata.normalize("NFC", name)
    listed = os.listdir(folder) if folder.is_dir() else []
    return folder / next((other for other in listed if unicodedata.normalize("NFC", other) == form), name)
