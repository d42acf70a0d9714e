"""Decides which frames are retaken: damaged, repeated, wrongly exposed, clipped, unsharp, or from another camera.

Frames are measured in the decoder's child process, so a damaged file cannot end polcap.
"""

from math import log2
from pathlib import Path

import cv2
import msgspec
import numpy as np

from polcap.capture_values import Exif
from polcap.errors import DecodeError
from polcap.formats import sandbox
from polcap.formats.capture import reader
from polcap.formats.raw import libraw as raw
from polcap.formats.raw import probe
from polcap.image_values import Floats
from polcap.optics import sensor
from polcap.optics.resize import area_mean, block_means
from polcap.rig.exposure_bracket import Exposure

BLURRED = "is less sharp than its neighbors; wait until the tripod is steady"
PREVIEW_PX = 480  # width of the small picture
_DIAL_STOPS = 0.34  # EXIF rounds an exposure by up to one step of the dial
_CLIP = 0.98  # of the saturated count, as `hdr.clip`
_MOST_CLIPPED = 0.01  # share of the picture, in the shortest exposure
_LEAST_SHARPNESS = 0.75  # of that of the sharpest frame of the same exposure


class FrameFacts(msgspec.Struct, frozen=True):
    """Facts that decide whether a frame is retaken; stored for a resume."""

    exif: Exif
    digest: str  # of the file's bytes
    clipped: float  # share of clipped counts
    sharpness: float  # contrast of fine detail over contrast of coarse detail


def inspect(path: Path) -> tuple[FrameFacts, Floats]:
    """Measure a frame: facts for the retake criteria, and a small gray picture (h, w), black = 0, saturation = 1.

    Raises DecodeError if the file is not a RAW, or is damaged.
    """
    file = probe.read(path)
    if file.kind != "raw":
        raise DecodeError(f"{path}: is not a RAW file; set the camera to RAW")
    numbers, arrays = sandbox.call(measure, path)
    return FrameFacts(file.exif, file.digest, numbers["clipped"], numbers["sharpness"]), arrays["small"]


def measure(path: str) -> sandbox.Answer:
    """In the child process: clipped share, sharpness and small picture of one RAW file."""
    image = raw.image(*raw.decode(path))
    value, black = image.value, float(image.black.mean())
    grey = value if value.ndim == 2 else value.mean(-1, dtype=np.float32)
    light = (block_means(np.asarray(grey, np.float32), max(image.superpixel, 2)) - black) / (image.white - black)
    height, width = light.shape
    small = area_mean(light, (round(height * min(width, PREVIEW_PX) / width), min(width, PREVIEW_PX)))
    return {"clipped": sensor.clipped_share(image, _CLIP), "sharpness": _sharpness(light)}, {"small": small}


def _sharpness(light: Floats) -> float:
    """Sharpness of a picture: contrast within 1 px over contrast within 4 px; almost independent of exposure."""
    blurred_1px, blurred_4px = (cv2.GaussianBlur(np.asarray(light, np.float32), (0, 0), sigma) for sigma in (1.0, 4.0))
    coarse = float(np.std(blurred_1px - blurred_4px))
    return float(np.std(light - blurred_1px)) / coarse if coarse > 0 else 0.0


def retake_reason(
    facts: FrameFacts, wanted: Exposure, flash: bool, shortest: bool, others: list[FrameFacts], sharpest: float
) -> str | None:
    """Reason for which a frame must be retaken; None for a good frame.

    `wanted` and `flash` are the planned exposure; `shortest`: it is the shortest of its bracket. `others` are the
    accepted frames of the capture, `sharpest` is the greatest sharpness of those with the same exposure.
    """
    if any(facts.digest == other.digest for other in others):
        return "is the same photograph as an earlier one"
    if fault := _wrong_exposure(facts.exif, wanted):
        return fault
    if facts.exif.flash_fired and not flash:
        return "the flash fired, although it should be off"
    if shortest and facts.clipped > _MOST_CLIPPED:
        return (
            f"{100 * facts.clipped:.2g} % of the picture is clipped in the shortest exposure, "
            f"more than {100 * _MOST_CLIPPED:g} %; give a shorter --bracket or less light"
        )
    if others and (difference := reader.other_equipment(facts.exif, others[0].exif)):
        return difference
    return BLURRED if is_blurred(facts.sharpness, sharpest) else None


def is_blurred(sharpness: float, sharpest: float) -> bool:
    """Whether a frame is less sharp than the sharpest of the same exposure, by more than the polarizer can cause."""
    return sharpness < _LEAST_SHARPNESS * sharpest


def _wrong_exposure(stated: Exif, wanted: Exposure) -> str | None:
    """The first setting of the camera that differs from the wanted one, in words; None if all agree."""
    rows = (
        ("exposure time [s]", wanted.time_s, stated.exposure_time, 1.0),
        ("f-number", wanted.f_number, stated.f_number, 2.0),
        ("ISO", wanted.iso, stated.iso, 1.0),
    )
    for name, expected, found, power in rows:
        if expected and found and power * abs(log2(found / expected)) > _DIAL_STOPS:
            return f"{name} {found:.4g}, but {expected:.4g} was set; set the camera to manual"
    return None
