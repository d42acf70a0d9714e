"""One frame as it lands: its file in, what is wrong with it out, or nothing.

Measured in the decoder's process, so that a damaged frame harms nobody and the next one is taken meanwhile.
"""

import io
from collections.abc import Iterable
from math import log2
from pathlib import Path

import cv2
import msgspec
import numpy as np

from polcap.errors import DecodeError
from polcap.formats.raw import file_kind, probe, worker
from polcap.formats.raw import libraw as raw
from polcap.images import Exif, Floats
from polcap.rig.camera import Exposure

PREVIEW_PX = 480  # width of the small picture
_STOPS = 0.34  # EXIF's exposure may differ from the one set by this: a step of the dial
_ZOOM = 0.01  # relative change of the focal length that is more than rounding
_SATURATED = 0.98  # of the white level
_MAKERS = {"nikon": ".nef", "sony": ".arw", "pentax": ".pef", "ricoh": ".pef", "samsung": ".srw", "canon": ".cr2"}
_MAGIC = ((b"FUJIFILMCCD-RAW", ".raf"), (b"\0MRM", ".mrw"), (b"FOVb", ".x3f"), (b"IIU\0", ".rw2"))


class Facts(msgspec.Struct, frozen=True):
    """What a frame is judged by, now and after a resume."""

    exif: Exif
    digest: str  # of the file's bytes
    clipped: float  # share of saturated pixels
    sharpness: float  # contrast of the finest detail over that of the coarser, 1


class Limits(msgspec.Struct, frozen=True):
    """How good a frame has to be."""

    clipped: float = 0.01  # share of the picture, in the shortest exposure
    blur: float = 0.75  # sharpness over the sharpest of the same exposure


def inspect(path: Path) -> tuple[Facts, Floats]:
    """Facts of a frame, and the frame small and grey (h, w) with black = 0 and saturation = 1.

    Raises
    ------
    DecodeError
        It is no RAW file, or damaged.
    """
    found = probe.read(path)
    if found.kind != "raw":
        raise DecodeError(f"{path}: is no RAW file; set the camera to RAW")
    about, arrays = worker.call(measure, path)
    return Facts(found.exif, found.digest, about["clipped"], about["sharpness"]), arrays["small"]


def measure(path: str) -> worker.Answer:
    """The numbers of one RAW file. In the worker."""
    meta, arrays = raw.decode(path)
    value, white = arrays["value"], meta["white"]
    black = float(np.mean(meta["black"]))
    clipped = float(np.mean(value >= black + _SATURATED * (white - black)))
    grey = value if value.ndim == 2 else value.mean(-1, dtype=np.float32)
    block = 3 if arrays.get("cfa", grey).shape == (6, 6) else 2  # of all colors
    height, width = (side // block for side in grey.shape)
    grey = grey[: block * height, : block * width]
    cells = cv2.resize(np.asarray(grey, np.float32), (width, height), interpolation=cv2.INTER_AREA)
    light = (cells - black) / (white - black)
    small_size = min(width, PREVIEW_PX), round(height * min(width, PREVIEW_PX) / width)
    small = cv2.resize(light, small_size, interpolation=cv2.INTER_AREA)
    return {"clipped": clipped, "sharpness": _sharpness(light)}, {"small": small}


def _sharpness(light: Floats) -> float:
    """Contrast within 1 px over contrast within 4 px; exposure and subject cancel, blur does not."""
    near, far = (cv2.GaussianBlur(np.asarray(light, np.float32), (0, 0), sigma) for sigma in (1.0, 4.0))
    coarse = float(np.std(near - far))
    return float(np.std(light - near)) / coarse if coarse > 0 else 0.0


def fault(
    facts: Facts, asked: Exposure, flash: bool, shortest: bool, others: Iterable[Facts], limits: Limits
) -> str | None:
    """Why a frame is to be taken again, beside blur; `others` are the good frames of the capture."""
    known = list(others)
    if any(facts.digest == other.digest for other in known):
        return "is the same photograph as an earlier one"
    wrong = _exposed(facts.exif, asked)
    if wrong:
        return wrong
    if flash is False and facts.exif.flash_fired:
        return "the flash fired, where it was to stay off"
    if shortest and facts.clipped > limits.clipped:
        return (
            f"{100 * facts.clipped:.2g} % of the picture are clipped in the shortest exposure, "
            f"more than {100 * limits.clipped:g} %; give a shorter --bracket or less light"
        )
    return _changed(facts.exif, known[0].exif) if known else None


def blurred(sharpness: float, sharpest: float, limits: Limits) -> bool:
    """Whether a frame is less sharp than the sharpest of the same exposure by more than angles explain."""
    return sharpness < limits.blur * sharpest


def _exposed(stated: Exif, asked: Exposure) -> str | None:
    rows = (
        ("exposure time [s]", asked.time_s, stated.exposure_time, 1.0),
        ("f-number", asked.f_number, stated.f_number, 2.0),
        ("ISO", asked.iso, stated.iso, 1.0),
    )
    for what, wanted, found, power in rows:
        if wanted and found and power * abs(log2(found / wanted)) > _STOPS:
            return f"{what} {found:.4g}, where {wanted:.4g} was set; set the camera to manual"
    return None


def _changed(here: Exif, first: Exif) -> str | None:
    if (here.make, here.model) != (first.make, first.model):
        return f"was taken with {here.make} {here.model}, not {first.make} {first.model}"
    if here.lens and first.lens and here.lens != first.lens:
        return f"was taken through {here.lens}, not {first.lens}"
    if (here.width, here.height) != (first.width, first.height):
        return f"has {here.width}×{here.height} px, not {first.width}×{first.height}"
    lengths = here.focal_length_mm, first.focal_length_mm
    if lengths[0] and lengths[1] and abs(lengths[0] / lengths[1] - 1) > _ZOOM:
        return f"was taken at {lengths[0]:g} mm, not {lengths[1]:g} mm"
    return None


def suffix(data: bytes, name: str) -> str:
    """File name suffix of a photograph by its content; the camera's own where the content is not known."""
    for magic, found in _MAGIC:
        if data.startswith(magic):
            return found
    if data[4:12] == b"ftypcrx ":
        return ".cr3"
    if data[6:14] == b"HEAPCCDR":
        return ".crw"
    if data[:4] in (b"IIRO", b"IIRS", b"MMOR"):
        return ".orf"
    if data[:3] == b"\xff\xd8\xff":
        return ".jpg"
    if data[:4] in (b"II*\0", b"MM\0*"):
        if file_kind.structure(io.BytesIO(data)).dng:
            return ".dng"
        head = data[:4096].lower()
        return next((found for maker, found in _MAKERS.items() if maker.encode() in head), ".tif")
    return Path(name).suffix.lower() or ".raw"
