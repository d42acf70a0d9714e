"""Decodes a finished picture (TIFF, PNG, EXR, JPEG) to linear values, by OpenImageIO in the child process.

16-bit and floating-point files are taken as linear, 8-bit files as sRGB-encoded, unless the caller states the encoding.
RAW files go to `libraw`: OpenImageIO opens a DNG as its thumbnail.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats.raw import file_bytes, file_checks, file_kind, libraw, worker
from polcap.images import FrameReading, SensorImage
from polcap.optics import color

Encoding = Literal["linear", "srgb"]
SENSOR_CELLS = {0.0: (1, 1), 45.0: (0, 1), 90.0: (0, 0), 135.0: (1, 0)}  # row, column of each angle [°] in a 2×2 cell
_MOST_CHANNELS = 64  # of a layered EXR
_DEFAULT = FrameReading("photo")
_COLOR_LEVELS = 0.05  # averages of neighboring 2×2 cells differ less than this on a monochrome sensor


def read(path: str | Path, reading: FrameReading = _DEFAULT, digest: str | None = None) -> SensorImage:
    """Decode a finished picture as linear values (H, W, 3); a gray picture is repeated in all three channels.

    Linear integers stay counts; for floating point, white is 1. An sRGB-encoded picture becomes linear 0…1. It and
    every 8-bit picture are marked `lossy`. With the `digest` of `probe.read`, the file must still have the bytes that
    were probed.

    Raises DecodeError: not a picture, damaged, or changed since it was probed.
    """
    pixels, full = _pixels(path, digest)
    lossy = pixels.dtype == np.uint8
    encoding = encoding_of(8 * pixels.itemsize, reading.encoding)
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    if encoding == "linear":
        white = reading.white or full
        return SensorImage(_counts(pixels), np.full((1, 1), reading.black), white, None, lossy=lossy)
    if pixels.dtype.kind == "f":
        value = color.decode_srgb(pixels).astype(np.float32)
    else:
        value = color.decode_srgb(np.arange(full + 1) / full).astype(np.float32)[pixels]
    return SensorImage(value, np.zeros((1, 1)), 1.0, None, lossy=True)


def read_mosaic(
    path: str | Path, angle_deg: float, reading: FrameReading = _DEFAULT, digest: str | None = None
) -> SensorImage:
    """One angle (0, 45, 90 or 135°) of a polarization sensor's raw frame, (H/2, W/2, 3), linear.

    The frame's 2×2 cell is 90 45 / 135 0 degrees. `digest` is as in `read`.

    Raises DecodeError: the frame is in color, or cannot be read.
    """
    y, x = SENSOR_CELLS[angle_deg]
    if reading.kind == "photo":
        pixels, full = _pixels(path, digest)
        if pixels.shape[2] != 1:
            raise DecodeError(
                f"{path}: has {pixels.shape[2]} channels, but the frame of a polarization sensor has one; "
                "save the camera's raw frame, or give one picture per angle"
            )
        mosaic, lossy, level = pixels[..., 0], pixels.dtype == np.uint8, reading.black
    else:
        sensor = libraw.read(path, digest)
        mosaic = sensor.value if sensor.value.ndim == 2 else sensor.value[..., 0]
        lossy, full = False, sensor.white
        level = reading.black or float(np.broadcast_to(sensor.black, (2, 2))[y, x])
    _check_monochrome(path, mosaic)
    height, width = mosaic.shape
    plane = mosaic[y : height // 2 * 2 : 2, x : width // 2 * 2 : 2]
    value = np.repeat(_counts(plane)[..., None], 3, axis=2)
    return SensorImage(value, np.full((1, 1), level), reading.white or full, None, lossy=lossy)


def place_px(angle_deg: float) -> tuple[float, float]:
    """Position (x, y) of an angle's pixels in the polarization sensor's 2×2 cell: 0 or ½ px of `read_mosaic`."""
    y, x = SENSOR_CELLS[angle_deg]
    return x / 2, y / 2


def encoding_of(bits: int, stated: Encoding | None) -> Encoding:
    """The encoding (linear or sRGB) of a picture with this number of bits per channel, unless the caller states one."""
    return stated or ("srgb" if bits == 8 else "linear")


def size(path: str, data: bytes) -> dict[str, int]:
    """In the child process: size, number of channels and bits of a picture, without decoding its pixels."""
    with opened(path, data) as file:
        spec = file.spec()
        count, bits = len(_channels(path, spec)), 8 * spec.format.size()
    return {"width": spec.width, "height": spec.height, "channels": count, "bits": bits}


def decode(path: str, digest: str | None = None) -> worker.Answer:
    """In the child process: the stored values of a picture (H, W, 1 or 3) in their stored type. Raises DecodeError."""
    with opened(path, file_bytes.load(path, digest)) as file:
        channels = _channels(path, file.spec())
        pixels = every_channel(path, file)[..., channels]
    if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
        bad = int((~np.isfinite(pixels)).sum())
        raise DecodeError(f"{path}: {bad} values are not finite numbers; write the file without NaN and infinity")
    return {}, {"pixels": pixels}


def every_channel(path: str, file: Any) -> NDArray[Any]:
    """All channels (H, W, C) of an open file of OpenImageIO: float32, or integers of their stored type. DecodeError."""
    import OpenImageIO as oiio

    spec = file.spec()
    kind = "float" if spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE) else str(spec.format)
    pixels = file.read_image(0, 0, 0, spec.nchannels, kind)
    if pixels is None:
        raise DecodeError(f"{path}: truncated or damaged ({reason(file)}); {file_checks.COPY_AGAIN}, or write it again")
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def reason(source: Any) -> str:
    """The last error of OpenImageIO (the module, an input or an output), in one line.

    Its message may repeat bytes of the file; where these are not UTF-8, the binding raises instead of returning it.
    """
    try:
        return " ".join(source.geterror().split()) or "no reason stated"
    except UnicodeDecodeError:
        return "the reason is not readable text"


def _pixels(path: str | Path, digest: str | None) -> tuple[NDArray[Any], float]:
    """Stored values of a picture, and the greatest value of their type (1 for floating point)."""
    pixels = worker.call(decode, path, digest=digest)[1]["pixels"]
    return pixels, 1.0 if pixels.dtype.kind == "f" else float(np.iinfo(pixels.dtype).max)


@contextmanager
def opened(path: str, data: bytes) -> Iterator[Any]:
    """Context manager: the bytes of a picture opened by OpenImageIO, which opens files by name only.

    Raises DecodeError.
    """
    import OpenImageIO as oiio

    if data.startswith(file_kind.JPEG):
        file_checks.check_jpeg(path, data)
    file_checks.check_png(path, data)
    options = oiio.ImageSpec()
    options["oiio:UnassociatedAlpha"] = 1  # else a PNG's colors are multiplied by its alpha
    with file_bytes.named(data) as name:
        file = oiio.ImageInput.open(name, options)
        if file is None:
            cause = reason(oiio).replace(name, Path(path).name)
            raise DecodeError(f"{path}: not a readable picture ({cause}); is the file complete?")
        try:
            spec = file.spec()
            file_checks.check_size(path, spec.width, spec.height)
            if spec.nchannels > _MOST_CHANNELS or spec.depth > 1:
                raise DecodeError(f"{path}: has {spec.nchannels} channels; polcap reads flat pictures")
            yield file
        finally:
            file.close()


def _channels(path: str, spec: Any) -> list[int]:
    """Indices of the picture's channels R, G and B, or of its single gray channel."""
    names = [name.rpartition(".")[2].upper() for name in spec.channelnames]
    if sum(name in ("R", "G", "B") for name in names) == 3:
        return [names.index(name) for name in "RGB"]
    grey = [i for i, name in enumerate(names) if i != spec.alpha_channel]
    if len(grey) == 1:
        return grey
    raise DecodeError(f"{path}: has the channels {', '.join(spec.channelnames)}; polcap reads R, G, B or one gray")


def _counts(pixels: NDArray[Any]) -> Any:
    return pixels if pixels.dtype == np.uint16 else pixels.astype(np.float32)


def _check_monochrome(path: str | Path, mosaic: NDArray[Any]) -> None:
    """Refuse the frame of a color polarization sensor: neighboring 2×2 cells with different color filters."""
    height, width = (size // 4 * 4 for size in mosaic.shape)
    cells = mosaic[:height, :width].reshape(height // 4, 2, 2, width // 4, 2, 2)
    levels = cells.mean(axis=(0, 2, 3, 5), dtype=np.float64)  # (2, 2)
    if levels.max() > (1 + _COLOR_LEVELS) * levels.min():
        raise DecodeError(
            f"{path}: neighboring 2×2 cells differ by {levels.max() / levels.min() - 1:.0%}, as on a color "
            "polarization sensor, which is not supported; give one demosaiced picture per angle"
        )
