"""The protocol of camera drivers: take one photograph with an exposure, and return its file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from polcap.capture_values import Role
from polcap.formats.raw import file_kind
from polcap.rig.exposure_bracket import Exposure

_SUFFIXES = {"nikon": ".nef", "sony": ".arw", "pentax": ".pef", "ricoh": ".pef", "samsung": ".srw", "canon": ".cr2"}


@dataclass(frozen=True)
class CameraFile:
    """One photograph as received from the camera: bytes, file name, exposure."""

    data: bytes
    name: str  # in the camera
    exposure: Exposure  # settings with which the camera took it

    @property
    def suffix(self) -> str:
        """File name suffix by the file's content; the camera's suffix if the content is not recognized."""
        if suffix := file_kind.raw_suffix(self.data):
            return suffix
        if self.data.startswith(file_kind.JPEG):
            return ".jpg"
        if self.data.startswith(file_kind.TIFF):
            if file_kind.structure(self.data).dng:
                return ".dng"
            head = self.data[:4096].lower()
            return next((suffix for maker, suffix in _SUFFIXES.items() if maker.encode() in head), ".tif")
        return Path(self.name).suffix.lower() or ".raw"


class Camera(Protocol):
    """Protocol that every camera driver implements."""

    model: str
    frame_bytes: int  # approximate size of a file, to check the free disk space
    switches_flash: bool  # switches the flash off without a person
    polarizes_flash: bool  # puts the filter on the flash without a person

    def bracket(self, flash: bool) -> tuple[Exposure, ...]:
        """Default exposures of the camera; they differ in ISO under a flash, which the shutter does not change."""
        ...

    def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
        """Prepare the camera before a frame: polarizer angle, role of the frame, its index in the bracket."""
        ...

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        """Take one photograph, with or without flash. Raises HardwareError; returns or fails within a time limit."""
        ...

    def close(self) -> None:
        """Disconnect from the camera; never raises."""
        ...
