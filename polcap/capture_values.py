"""A capture as its folder describes it: photographs, shots, stated angles and the camera's geometry."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from msgspec import Struct

from polcap.calibration_values import BallAccuracy, Calibration
from polcap.image_values import NOT_IN_KEY, Floats, SensorImage

T = TypeVar("T")
Role = Literal["shot", "ambient", "repeat", "chart", "cross"]


@dataclass(frozen=True)
class Exif:
    """Camera settings of one photograph from its EXIF tags; None or "" where the file has no value."""

    make: str = ""
    model: str = ""
    lens: str = ""
    exposure_time: float | None = None  # s
    f_number: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None  # mm, full-frame equivalent
    pixel_pitch_um: float | None = None  # from FocalPlaneResolution, visible RAW pixels
    taken: str = ""  # ISO 8601 with sub-seconds where known
    flash_fired: bool | None = None
    width: int | None = None  # visible RAW pixels
    height: int | None = None
    serial: str = field(default="", metadata=NOT_IN_KEY)  # of the camera
    upright_deg: int = field(default=0, metadata=NOT_IN_KEY)  # counter-clockwise turn of the stored pixels
    color_matrix: tuple[float, ...] | None = None  # 9, XYZ (D65 or the nearest stated illuminant) → camera

    @property
    def camera(self) -> str:
        return f"{self.make} {self.model}".strip()

    @property
    def relative_exposure(self) -> float | None:
        """Exposure by the camera settings [s · ISO/100 / f-number²]; not valid under flash."""
        if self.exposure_time is None:
            return None
        aperture = self.f_number or 1.0  # a lens without electronics reports 0
        return self.exposure_time * (self.iso or 100.0) / 100.0 / aperture**2


@dataclass(frozen=True)
class FrameReading:
    """Options for reading the pixels of a frame's file."""

    kind: Literal["raw", "photo"] = "raw"
    encoding: Literal["linear", "srgb"] | None = None  # of a developed picture; None: sRGB for 8 bits, otherwise linear
    white: float | None = None  # counts; None: from the file, or the largest value of its type
    black: float = 0.0  # counts
    cell: tuple[int, int] | None = None  # row, column to extract from the 2×2 cell of a polarization sensor's mosaic


@dataclass(frozen=True)
class Frame:
    """One photograph of a capture; a `Decode` function reads its pixels."""

    path: str = field(metadata=NOT_IN_KEY)
    exif: Exif
    role: Role
    digest: str  # of the file's bytes, then the reading options that change its pixels
    exposure: float | None = None  # relative, from capture.toml; replaces EXIF
    reading: FrameReading = field(default=FrameReading(), metadata=NOT_IN_KEY)


def middle(bracket: Sequence[T]) -> T:
    """The middle one of a sorted bracket; of an even number, the one before the middle."""
    return bracket[(len(bracket) - 1) // 2]


Decode = Callable[[Frame], SensorImage]  # as `formats.raw.frame_decoder.decode`


@dataclass(frozen=True)
class Shot:
    """All photographs of one polarizer angle: a bracket of exposures, and ambient frames."""

    angle: float  # rad, from image x towards image up
    frames: tuple[Frame, ...]  # (E,) sorted by stated exposure, else by name; e is the same exposure in all shots
    ambient: tuple[Frame, ...] = ()  # flash off, same settings
    place_px: tuple[float, float] = (0.0, 0.0)  # x, y of its pixel (0, 0) on the grid of a sensor's 2×2 cells [cells]

    @property
    def name(self) -> str:
        return f"{np.degrees(self.angle):g}°"


class CatalogEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """Facts for the catalog of a collection: the table `[catalog]` of capture.toml; an empty text is not stated."""

    title: str = ""  # of the object
    creator: str = ""  # person or institution that made the photographs
    rights: str = ""  # copyright notice
    license: str = ""  # address or name of the license
    object_number: str = ""  # inventory number of the object
    date: str = ""  # when the object was made
    institution: str = ""  # that keeps the object
    description: str = ""  # of the object


@dataclass(frozen=True)
class ShotOrder:
    """A possible assignment of the stated polarizer angles to the shots: their order, and the sense of rotation."""

    shots: tuple[int, ...]  # (K,) index of the stated angle of each shot
    mirrored: bool = False  # angles count clockwise


@dataclass(frozen=True)
class AngleStatement:
    """The place where a capture states the polarizer angles of its shots."""

    place: Literal["folders", "capture.toml", "file names", "order", "cells"] = "folders"
    texts: tuple[str, ...] = ()  # (K,) folder or file that names the angle of each shot, or the angle as stated
    cells: tuple[tuple[int, int], ...] = ()  # (K,) row, column of each shot in a polarization sensor's 2×2 cell
    clockwise: Literal["", "stated", "calibrated"] = ""  # by the user, or by the ring's calibration


@dataclass(frozen=True, repr=False)
class Capture:
    """A capture: all photographs of one object, and the camera's geometry. The input of a run."""

    name: str = field(metadata=NOT_IN_KEY)
    folder: str = field(metadata=NOT_IN_KEY)
    shots: tuple[Shot, ...]  # (K,) with brackets of equal length; the first is the reference
    layout: Literal["folders", "toml", "flat", "sensor"]
    focal_px: float  # in visible RAW pixels
    focal_known: bool
    principal_px: tuple[float, float]  # in visible RAW pixels
    size_px: tuple[int, int]  # width, height, visible RAW pixels
    chart_frames: tuple[Frame, ...] = ()
    notes: tuple[str, ...] = field(default=(), metadata=NOT_IN_KEY)  # on how the folder was read, one line each
    focal_doubt: tuple[float, float] = field(default=(0.0, 0.0), metadata=NOT_IN_KEY)  # ln of least, largest / focal_px
    calibration: Calibration | None = None  # of this camera, lens and filter, if measured
    crossed: Shot | None = None  # under a polarized flash; its angle is that of the lens's polarizer
    catalog: CatalogEntry = field(default=CatalogEntry(), metadata=NOT_IN_KEY)
    angles: AngleStatement = AngleStatement()
    lens_filter: str = field(default="", metadata=NOT_IN_KEY)  # the polarizer's name, from capture.toml
    accuracy: BallAccuracy | None = field(default=None, metadata=NOT_IN_KEY)  # with this equipment; None: not validated

    def __repr__(self) -> str:
        shots = ", ".join(f"{shot.name}: {len(shot.frames)}" for shot in self.shots)
        return f"Capture({self.name!r}, {self.layout}, frames {shots}; {self.size_px[0]} × {self.size_px[1]} px)"

    def file_name(self, frame: Frame) -> str:
        """Path of a photograph's file, relative to the capture's folder if the file is in it."""
        path = Path(frame.path)
        return (path.relative_to(self.folder) if path.is_relative_to(self.folder) else path).as_posix()

    @property
    def all_shots(self) -> tuple[Shot, ...]:
        """The capture's shots, and the cross-polarized shot if there is one."""
        return self.shots if self.crossed is None else (*self.shots, self.crossed)

    @property
    def upright_deg(self) -> int:
        """Counter-clockwise turn [degrees] that sets the pictures upright; 0 unless all photographs state the same."""
        turns = {frame.exif.upright_deg for shot in self.all_shots for frame in shot.frames}
        return turns.pop() if len(turns) == 1 else 0

    @property
    def angle(self) -> Floats:
        """Polarizer axes (K,) rad of the shots: as stated, or corrected by the ring's calibration."""
        return self._calibrated(np.array([shot.angle for shot in self.shots]))

    @property
    def crossed_angle(self) -> float:
        """Polarizer axis [rad] of the cross-polarized shot; NaN without one."""
        return float("nan") if self.crossed is None else float(self._calibrated(np.array(self.crossed.angle)))

    def _calibrated(self, stated: Floats) -> Floats:
        ring = self.calibration.polarizer if self.calibration is not None else None
        return stated if ring is None else ring.sense * stated + np.radians(ring.zero_deg)
