"""Decodes a RAW file to sensor counts, levels and colors, by LibRaw in the child process.

The only module that imports rawpy.
"""

import io
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.capture_values import Exif
from polcap.errors import DecodeError
from polcap.formats import sandbox
from polcap.formats.raw import dng_black, exif, file_bytes, file_checks, file_kind
from polcap.image_values import Bits, Floats, SensorImage
from polcap.optics import demosaic
from polcap.optics.color import REC709_TO_XYZ

_EIGHT_BITS = 255  # counts between black and white: rounding alone is 1 % of a dark patch
_MAX_CONDITION = 1e4  # of a color matrix; above, its inverse is meaningless. Set by hand


def read(path: str | Path, digest: str | None = None) -> SensorImage:
    """Decode one RAW file to sensor counts: black level not subtracted, masked border removed.

    A Bayer file gives its mosaic (H, W), with `black` and `cfa` (2, 2) that begin at the first visible pixel. An
    X-Trans file gives it from its first whole 3×3 block on, with `black` and `cfa` (6, 6). A file of linear channels,
    or of a monochrome sensor, gives (H, W, 3) and no `cfa`. `camera_matrix` includes the white balance: it converts the
    camera's response to a grey, 1/`white_balance`, to (1, 1, 1). With the `digest` of `probe.read`, the file must still
    have the bytes that were probed.

    Raises DecodeError: not a RAW, damaged, changed since, of another mosaic or Foveon; or the decoder crashed, hung or
    ran out of memory.
    """
    return image(*sandbox.call(decode, path, digest=digest))


def image(meta: dict[str, Any], arrays: sandbox.Arrays) -> SensorImage:
    """Build a SensorImage from the answer of `decode`."""
    balance = None if meta["balance"] is None else np.array(meta["balance"])
    xyz_to_camera = meta["xyz_to_camera"]
    return SensorImage(
        value=arrays["value"],
        black=np.array(meta["black"]),
        white=meta["white"],
        cfa=arrays.get("cfa"),
        camera_matrix=None if xyz_to_camera is None else camera_matrix(np.reshape(xyz_to_camera, (3, 3)), balance),
        white_balance=balance,
        lossy=meta["lossy"],
    )


def camera_matrix(xyz_to_camera: Floats, balance: Floats | None) -> Floats | None:
    """Color matrix (3, 3) from camera RGB to linear Rec.709, including the white balance (3,); None: daylight's.

    The result is None if the matrix XYZ → camera cannot be inverted.

    References
    ----------
    Adobe, Digital Negative Specification 1.4, ch. 6; dcraw's normalization to the white of D65.
    """
    if not np.isfinite(xyz_to_camera).all():
        return None
    camera = xyz_to_camera @ REC709_TO_XYZ
    daylight = camera.sum(axis=1)  # the camera's response to D65
    if (daylight <= 0).any():
        return None
    normalized = camera / daylight[:, None]  # white gives 1 in every channel, in any unit of the file
    if np.linalg.cond(normalized) > _MAX_CONDITION:
        return None
    to_rec709 = np.linalg.inv(normalized)
    gain = daylight[1] / daylight if balance is None else balance
    return np.asarray(to_rec709 * gain)


@contextmanager
def _opened(path: str, data: bytes) -> Iterator[Any]:
    """Context manager: the bytes opened as a RAW by LibRaw, size checked; LibRaw's errors become DecodeError."""
    import rawpy

    try:
        raw = rawpy.RawPy()  # never closed: the counts are a view into it, which keeps it alive
        raw.open_buffer(io.BytesIO(data))
        sizes = raw.sizes  # unpacks nothing, unlike every other property
        file_checks.check_size(path, sizes.width, sizes.height)
        file_checks.check_size(path, sizes.raw_width, sizes.raw_height)
        file_checks.check_bytes(path, sizes.width, sizes.height, len(data))
        yield raw
    except (rawpy.LibRawError, NotImplementedError) as error:
        reason = next(iter(error.args), type(error).__name__)
        reason = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        if isinstance(error, rawpy.LibRawFileUnsupportedError):
            message = f"not a RAW format that LibRaw knows ({reason}); is the file complete?"
        elif isinstance(error, NotImplementedError):
            message = f"a RAW layout that is not supported ({reason}); convert it to DNG"
        else:
            message = f"truncated or damaged ({reason}); {file_checks.COPY_AGAIN}"
        raise DecodeError(f"{path}: {message}") from None


def size(path: str, data: bytes, unpack: bool) -> dict[str, Any]:
    """In the child process: size of a RAW in visible pixels; with `unpack` also the metadata as LibRaw reads them."""
    with _opened(path, data) as raw:
        meta: dict[str, Any] = {"width": raw.sizes.width, "height": raw.sizes.height}
        return meta | ({"exif": _settings(raw.other, raw.lens)} if unpack else {})


def _settings(other: Any, lens: Any) -> dict[str, Any]:
    """Camera settings as LibRaw reads them, as fields of `Exif`."""
    stamp = other.timestamp
    settings = Exif(
        lens=(lens.model or "").strip(),
        exposure_time=other.shutter_speed or None,
        f_number=other.aperture or None,
        iso=other.iso_speed or None,
        focal_length_mm=other.focal_length or None,
        taken=stamp.isoformat() if stamp and stamp.year > 1970 else "",
    )
    return {name: value for name, value in asdict(settings).items() if value}


def version() -> str:
    """LibRaw's version."""
    import rawpy

    return ".".join(map(str, rawpy.libraw_version))


def decode(path: str, digest: str | None = None) -> sandbox.Answer:
    """In the child process: decode a RAW file to counts (H, W) or (H, W, 3), levels and colors. Raises DecodeError."""
    data = file_bytes.load(path, digest)
    if data[:4] == b"FOVb":  # Sigma's X3F
        raise DecodeError(f"{path}: {unsupported(None)}")
    structure = file_kind.structure(data)
    file_checks.check_structure(path, structure, data)
    if structure.dng and structure.truncated:  # LibRaw would return whatever was in memory
        raise DecodeError(f"{path}: its image data run past the end of the file; {file_checks.COPY_AGAIN}")
    with _opened(path, data) as raw:
        meta, arrays = _counts(path, raw, structure)
    lossy = file_checks.is_lossy(structure)
    file_checks.check_levels(path, arrays["value"], float(np.max(meta["black"])), meta["white"], lossy)
    stated = exif.tags(data).color_matrix
    meta["lossy"] = lossy or meta["white"] - float(np.min(meta["black"])) <= _EIGHT_BITS
    return meta | ({} if stated is None else {"xyz_to_camera": stated}), arrays


def _counts(path: str, raw: Any, structure: file_kind.TiffStructure) -> tuple[dict[str, Any], sandbox.Arrays]:
    """Visible sensor counts as stored in the RAW file, with their levels and colors; uneven blacks are evened out."""
    value: NDArray[Any] = raw.raw_image_visible
    value = value[..., :3] if value.ndim == 3 else value
    channels = math.prod(value.shape[2:])
    blacks, common_black = dng_black.levels_by_photosite(structure, raw.sizes, channels), None
    if blacks is None and value.ndim == 3:
        blacks = np.array(raw.black_level_per_channel[:channels], np.float64)
    if blacks is not None:  # `common_black` is then that of all photosites
        value, common_black = dng_black.even_out(value, blacks)
    balance, matrix = raw.camera_whitebalance[:3], raw.rgb_xyz_matrix[:3]
    meta: dict[str, Any] = {
        "balance": [gain / balance[1] for gain in balance] if min(balance) > 0 else None,
        "xyz_to_camera": matrix.tolist() if matrix.any() else None,
    }
    if value.ndim == 3 and value.shape[2] == 3:
        if raw.num_colors != 3:
            raise DecodeError(f"{path}: has {raw.num_colors} color channels where 3 are supported")
        arrays, black = {"value": value}, [[0.0]]
    elif value.ndim == 2 and raw.num_colors == 1:
        arrays = {"value": np.repeat(value[..., None], 3, axis=2)}
        black = [[float(raw.black_level_per_channel[0])]]
    else:
        cfa, black = _mosaic(raw, path)
        if cfa.shape == (6, 6):  # X-Trans, from its first whole 3×3 block on
            corner = demosaic.x_trans_corner(cfa)
            if corner is None:
                raise DecodeError(f"{path}: {unsupported((6, 6))}")
            down, right = corner
            cfa, levels = (np.roll(part, (-down, -right), (0, 1)) for part in (cfa, np.array(black)))
            value, black = np.ascontiguousarray(value[down:, right:]), levels.tolist()
        arrays = {"value": value, "cfa": cfa}
    black = black if common_black is None else [[common_black]]
    return meta | {"black": black, "white": _white(raw, float(np.max(black)))}, arrays


def unsupported(shape: tuple[int, ...] | None, rotated: bool = False) -> str:
    """Message why a color filter array with this period (rows, columns) cannot be used; None means a Foveon sensor.

    `rotated`: the rows of photosites run at 45° to those of the picture.
    """
    if shape is None:
        reason = "not in front of each pixel: it is a Foveon's layers, or sub-sampled color"
    elif rotated:
        reason = "Fujifilm's SuperCCD, turned by 45°"
    else:
        reason = f"a mosaic of {'×'.join(map(str, shape))}"
    return f"its color filter is {reason}, {file_checks.DEVELOP}"


def _mosaic(raw: Any, path: str) -> tuple[Bits, list[list[float]]]:
    """Colors and black levels of one period of the color filter array, (2, 2) or (6, 6)."""
    pattern = raw.raw_pattern
    if pattern is None or pattern.shape not in ((2, 2), (6, 6)):
        rotated = raw.sizes.width * raw.sizes.height > raw.sizes.raw_width * raw.sizes.raw_height
        raise DecodeError(f"{path}: {unsupported(None if pattern is None else pattern.shape, rotated)}")
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    period = range(len(pattern))
    index = [[raw.raw_color(top + y, left + x) for x in period] for y in period]
    names = raw.color_desc.decode()
    letters = [[names[i] for i in row] for row in index]
    expected = {2: {"R": 1, "G": 2, "B": 1}, 6: {"R": 8, "G": 20, "B": 8}}[len(pattern)]
    if Counter(letter for row in letters for letter in row) != expected:
        raise DecodeError(f"{path}: its mosaic is {letters}, not of red, green and blue; polcap does not support it")
    cfa = np.array([["RGB".index(letter) for letter in row] for row in letters], np.uint8)
    levels = raw.black_level_per_channel  # in the order of the color index
    return cfa, [[float(levels[i]) for i in row] for row in index]


def _white(raw: Any, black: float) -> float:
    """White level (saturated count): the lower of LibRaw's and the camera's, unless below half of LibRaw's."""
    stated = [level for level in raw.camera_white_level_per_channel or () if level > black]
    lowest = min([raw.white_level, *stated])
    return float(lowest if lowest > raw.white_level / 2 else raw.white_level)
