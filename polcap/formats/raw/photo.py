"""Decodes a finished picture (TIFF, PNG, EXR, JPEG) to linear values, by OpenImageIO in the child process.

The encoding is that of the caller, or that of the file (`color_encoding`); without both, files of 16 bits and of
floating point are linear, files of 8 bits sRGB. RAW files go to `libraw`: OpenImageIO opens a DNG as its thumbnail.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.capture_values import FrameReading
from polcap.errors import DecodeError
from polcap.formats import sandbox
from polcap.formats.raw import color_encoding, file_bytes, file_checks, file_kind, libraw, picture_count
from polcap.formats.raw.color_encoding import ColorEncoding
from polcap.image_values import SensorImage
from polcap.optics import color

Encoding = Literal["linear", "srgb"]
SENSOR_CELLS = ((90.0, 45.0), (135.0, 0.0))  # angles [°] in the 2×2 cell of the usual polarization sensor
_OTHER_COLORS = {5: "CMYK", 8: "CIELAB", 9: "ICCLAB", 10: "ITULAB", 32844: "LogL", 32845: "LogLuv"}  # of a TIFF
_FIREFLIES, _FAR_ABOVE = 1e-4, 16.0  # their greatest share of a picture; a glint's value over those of all else
_MOST_CHANNELS = 64  # of a layered EXR
_DEFAULT = FrameReading("photo")
_DIAGONALS = 0.1  # relative difference of the sums along both diagonals of a polarization sensor's cell; measured: 0.02
_COLOR_LEVELS = 0.05  # averages of neighboring 2×2 cells differ less than this on a monochrome sensor


def read(path: str | Path, reading: FrameReading = _DEFAULT, digest: str | None = None) -> SensorImage:
    """Decode a finished picture as linear values (H, W, 3); a gray picture is repeated in all three channels.

    Linear integers stay counts; for floating point, white is 1. Encoded pictures become linear 0…1. They and all 8-bit
    pictures are marked `lossy`. Primaries that the file states give the `camera_matrix`. With the `digest` of
    `probe.read`, the file must still have the bytes that were probed.

    Raises DecodeError: not a picture, damaged, changed since it was probed, of a contradictory encoding, or a mosaic.
    """
    meta, arrays = sandbox.call(decode, path, digest=digest, stated=reading.encoding)
    pixels, matrix = arrays["pixels"], meta["to_rec709"]
    lossy, black, white = meta["lossy"], reading.black, reading.white or meta["full"]
    if "light_of_code" in arrays:
        pixels, black, white = arrays["light_of_code"][pixels], 0.0, 1.0
    elif meta["decoded"]:
        black, white = 0.0, 1.0
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    camera_matrix = np.reshape(matrix, (3, 3)) if matrix else None
    return SensorImage(_counts(pixels), np.full((1, 1), black), white, None, camera_matrix, lossy=lossy)


def read_mosaic(
    path: str | Path, cell: tuple[int, int], reading: FrameReading = _DEFAULT, digest: str | None = None
) -> SensorImage:
    """One angle of a polarization sensor's raw frame, (H/2, W/2, 3), linear: the pixels at `cell`, row and column.

    `digest` is as in `read`. Raises DecodeError: the frame is in color, or cannot be read.
    """
    y, x = cell
    if reading.kind == "photo":
        meta, arrays = sandbox.call(decode, path, digest=digest, stated="linear", mosaic=True)
        pixels, full = arrays["pixels"], meta["full"]
        if pixels.shape[2] != 1:
            raise DecodeError(
                f"{path}: has {pixels.shape[2]} channels, but the frame of a polarization sensor has one; "
                "save the camera's raw frame, or give one picture per angle"
            )
        mosaic, lossy, black = pixels[..., 0], pixels.dtype == np.uint8, reading.black
    else:
        sensor = libraw.read(path, digest)
        mosaic = sensor.value if sensor.value.ndim == 2 else sensor.value[..., 0]
        lossy, full = False, sensor.white
        black = reading.black or float(np.broadcast_to(sensor.black, (2, 2))[y, x])
    _check_monochrome(path, mosaic)
    height, width = mosaic.shape
    plane = mosaic[y : height // 2 * 2 : 2, x : width // 2 * 2 : 2]
    value = np.repeat(_counts(plane)[..., None], 3, axis=2)
    return SensorImage(value, np.full((1, 1), black), reading.white or full, None, lossy=lossy)


def encoding_of(bits: int, found: ColorEncoding) -> str:
    """Name of the encoding of a picture that states `found`: linear, srgb or another; by its bits if it states none."""
    return found.curve or ("srgb" if bits == 8 else "linear")


def describe(path: str, data: bytes) -> dict[str, Any]:
    """In the child process: size, channels, bits, encoding and greatest float of a picture. Raises DecodeError."""
    with opened(path, data) as file:
        picture_count.check_single(path, data, file)
        spec = file.spec()
        channels, bits = len(_channels(path, spec)), 8 * spec.format.size()
        encoding, _ = color_encoding.read(data, spec)
        top = _top(_values(path, file)) if _is_float(spec) else 0.0
        left, upper, right, lower = _display(spec)
    facts = {"channels": channels, "bits": bits, "encoding": encoding, "top": top}
    return {"width": right - left, "height": lower - upper, **facts}


def decode(
    path: str, digest: str | None = None, stated: Encoding | None = None, mosaic: bool = False
) -> sandbox.Answer:
    """In the child process: the stored values of a picture (H, W, 1 or 3) in their stored type. Raises DecodeError.

    `stated` replaces the encoding that the file states. `light_of_code` is the linear light 0…1 of each stored
    integer, if the picture is not linear; floating point is `decoded` already. `mosaic`: a gray picture may be one.
    """
    data = file_bytes.load(path, digest)
    with opened(path, data) as file:
        picture_count.check_single(path, data, file)
        pixels = _values(path, file)
        found, curve = color_encoding.read(data, file.spec())
    if stated is None and found.fault:
        raise DecodeError(f"{path}: {found.fault}")
    if pixels.shape[2] == 1 and not mosaic:
        file_checks.check_no_mosaic(path, pixels[..., 0])
    name = stated or encoding_of(8 * pixels.itemsize, found)
    curve = color.decode_srgb if name == "srgb" else curve
    floats, arrays = pixels.dtype.kind == "f", {"pixels": pixels}
    full = 1 if floats else int(np.iinfo(pixels.dtype).max)
    if name != "linear" and floats:
        arrays["pixels"] = curve(pixels).astype(np.float32)
    elif name != "linear":
        arrays["light_of_code"] = curve(np.arange(full + 1) / full).astype(np.float32)
    lossy = name != "linear" or pixels.dtype == np.uint8
    return {"full": full, "lossy": lossy, "decoded": name != "linear", "to_rec709": found.to_rec709}, arrays


def _is_float(spec: Any) -> bool:
    return str(spec.format) in ("half", "float", "double")


def _top(pixels: NDArray[Any]) -> float:
    """Greatest value of a picture (H, W, C); fireflies, a renderer's few pixels far above all others, are limited.

    They are a share `_FIREFLIES` of the pixels, or 20 in a small picture.
    """
    brightest = pixels.max(axis=2).ravel()
    beyond = min(max(20, round(_FIREFLIES * brightest.size)), brightest.size - 1)
    return float(min(brightest.max(), _FAR_ABOVE * np.partition(brightest, -1 - beyond)[-1 - beyond]))


def _display(spec: Any) -> tuple[int, int, int, int]:
    """The picture's window: left, upper, right, lower [px], of an EXR its display window."""
    if spec.getattribute("openexr:lineOrder") is None:
        return spec.x, spec.y, spec.x + spec.width, spec.y + spec.height
    return spec.full_x, spec.full_y, spec.full_x + spec.full_width, spec.full_y + spec.full_height


def _values(path: str, file: Any) -> NDArray[Any]:
    """The picture's channels (H, W, 1 or 3); 0 where an EXR's data window holds no pixels. Raises DecodeError."""
    pixels = _display_window(path, file)[..., _channels(path, file.spec())]
    if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
        bad = int((~np.isfinite(pixels)).sum())
        raise DecodeError(f"{path}: {bad} values are not finite numbers; write the file without NaN and infinity")
    return pixels


def _display_window(path: str, file: Any) -> NDArray[Any]:
    """Pixels (H, W, C) of an EXR's display window; 0 where none is stored. Raises DecodeError."""
    spec, pixels = file.spec(), _every_channel(path, file)
    left, upper, right, lower = _display(spec)
    if (left, upper, right, lower) == (spec.x, spec.y, spec.x + spec.width, spec.y + spec.height):
        return pixels
    file_checks.check_size(path, right - left, lower - upper)
    x, y = spec.x - left, spec.y - upper  # of the first stored pixel in the picture
    inner = pixels[max(-y, 0) : max(lower - spec.y, 0), max(-x, 0) : max(right - spec.x, 0)]
    if not inner.size:
        raise DecodeError(f"{path}: its data window lies outside its display window; write both alike")
    picture = np.zeros((lower - upper, right - left, pixels.shape[2]), pixels.dtype)
    picture[max(y, 0) :, max(x, 0) :][: inner.shape[0], : inner.shape[1]] = inner
    return picture


def stored_channels(path: str, signature: bytes, kind: str) -> tuple[list[str], NDArray[Any]]:
    """Names and values (H, W, C) of all channels in a file that begins with `signature`. Raises DecodeError."""
    data = file_bytes.load(path)
    if not data.startswith(signature):
        raise DecodeError(f"{path} is not {kind}; write it again")
    with opened(path, data) as file:
        return list(file.spec().channelnames), _every_channel(path, file)


def _every_channel(path: str, file: Any) -> NDArray[Any]:
    """All channels (H, W, C) of an open file of OpenImageIO: float32, or integers of their stored type. DecodeError."""
    spec = file.spec()
    kind = "float" if _is_float(spec) else str(spec.format)
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


@contextmanager
def opened(path: str, data: bytes) -> Iterator[Any]:
    """Context manager: bytes of a picture opened by OpenImageIO, which needs a file name. Raises DecodeError."""
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
    """Indices of the picture's channels R, G and B, or of its single gray channel. Raises DecodeError."""
    if other_colors := _OTHER_COLORS.get(spec.getattribute("tiff:PhotometricInterpretation")):
        raise DecodeError(f"{path}: its colors are {other_colors}; save it as RGB")
    names = [name.rpartition(".")[2].upper() for name in spec.channelnames]
    if sum(name in ("R", "G", "B") for name in names) == 3:
        return [names.index(name) for name in "RGB"]
    grey = [i for i, name in enumerate(names) if i != spec.alpha_channel]
    if len(grey) == 1:
        return grey
    named = f"{', '.join(spec.channelnames[:4])}{', …' if len(spec.channelnames) > 4 else ''}"
    raise DecodeError(
        f"{path}: has {len(spec.channelnames)} channels ({named}), not R, G, B or one gray; give the folder of the "
        "photographs, or take this file out of it"
    )


def _counts(pixels: NDArray[Any]) -> Any:
    return pixels if pixels.dtype == np.uint16 else pixels.astype(np.float32)


def _check_monochrome(path: str | Path, mosaic: NDArray[Any]) -> None:
    """Refuse mosaics of colors: a color polarization sensor's, with unlike 2×2 cells, and one without polarizers.

    In a cell of polarizers, the diagonals have the same sum: I0 + I90 = I45 + I135.
    """
    height, width = (size // 4 * 4 for size in mosaic.shape)
    cells = mosaic[:height, :width].reshape(height // 4, 2, 2, width // 4, 2, 2)
    levels = cells.mean(axis=(0, 2, 3, 5), dtype=np.float64)  # (2, 2)
    if levels.max() > (1 + _COLOR_LEVELS) * levels.min():
        raise DecodeError(
            f"{path}: neighboring 2×2 cells differ by {levels.max() / levels.min() - 1:.0%}, as on a color "
            "polarization sensor, which is not supported; give one demosaiced picture per angle"
        )
    (a, b), (c, d) = cells.mean(axis=(0, 1, 3, 4), dtype=np.float64)
    difference = abs(a + d - b - c) / max(b + c, 1e-9)
    if difference > _DIAGONALS:
        raise DecodeError(
            f"{path}: the diagonals of its 2×2 cells differ by {difference:.0%}, as in a mosaic of colors, not of "
            "polarizers; give the camera's RAW, or one developed picture per angle"
        )
