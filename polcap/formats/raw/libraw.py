"""A RAW file's path in, its sensor counts out: decoded by LibRaw in the worker, lossless JPEG of a DNG faster.

The only module that imports rawpy, and only in the child process.
"""

import importlib
import io
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats.raw import dng_jpeg, exif, photo_bytes, plausible, sniff, worker
from polcap.images import Bits, Exif, Floats, SensorImage
from polcap.optics import demosaic
from polcap.optics.color import REC709_TO_XYZ

_EIGHT_BITS = 255  # counts between black and white: rounding alone is 1 % of a dark patch
_MOST_CONDITION = 1e4  # of a color matrix; beyond, its inverse tells nothing. Set by hand
_COPY_AGAIN = "copy it from the card again"


def read(path: str | Path, digest: str | None = None) -> SensorImage:
    """Decode one RAW file, nothing subtracted, without the masked border.

    A Bayer file gives its mosaic (H, W) with `black` (2, 2) and `cfa` in the phase of its
    first visible pixel; an X-Trans file from its first whole 3×3 block on, (6, 6) both. A file of
    finished linear channels, or of a monochrome sensor, gives (H, W, 3) and no `cfa`.
    `camera_matrix` holds the white balance: it takes the camera's answer to a grey in the light of
    the shot, 1/`white_balance`, to (1, 1, 1).
    With `digest`, of `probe.read`, the bytes that are decoded are those that were probed.

    Raises
    ------
    DecodeError
        Not a RAW, damaged, changed since, of another mosaic or Foveon; or the decoder crashed, hung or ran out
        of memory.
    """
    return _image(*worker.call(decode, path, digest=digest))


def within(
    path: str | Path, digest: str | None, function: Callable[..., worker.Answer], **options: Any
) -> worker.Answer:
    """What a function makes of the decoded file in the worker: only that comes back.

    Parameters
    ----------
    path, digest
        As in `read`.
    function
        Of a module's top level; of a `SensorImage` and `options`.
    options
        Plain JSON values.

    Raises
    ------
    DecodeError
        As in `read`.
    """
    return worker.call(apply, path, digest=digest, module=function.__module__, name=function.__name__, options=options)


def apply(path: str, digest: str | None, module: str, name: str, options: dict[str, Any]) -> worker.Answer:
    """The same, in the worker.

    Parameters
    ----------
    path, digest, options
        As in `within`.
    module, name
        Where the function stands.
    """
    function = getattr(importlib.import_module(module), name)
    answer: worker.Answer = function(_image(*decode(path, digest)), **options)
    return answer


def _image(meta: dict[str, Any], arrays: worker.Arrays) -> SensorImage:
    """A decoded frame of the worker's answer."""
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
    """Camera RGB → linear Rec.709 (3, 3), with the white balance (3,) in it; daylight's where None.

    References
    ----------
    Adobe, Digital Negative Specification 1.4, ch. 6; dcraw's normalisation to the white of D65.
    """
    camera = xyz_to_camera @ REC709_TO_XYZ
    daylight = camera.sum(axis=1)  # the camera's answer to D65
    if not np.isfinite(camera).all() or (daylight <= 0).any():
        return None
    even = camera / daylight[:, None]  # white gives 1 in every channel, whatever the file's units
    if np.linalg.cond(even) > _MOST_CONDITION:
        return None
    to_rec709 = np.linalg.inv(even)
    gain = daylight[1] / daylight if balance is None else balance
    return np.asarray(to_rec709 * gain)


def size(path: str, data: bytes, unpack: bool) -> dict[str, Any]:
    """Size in visible pixels, and with `unpack` LibRaw's own reading of the metadata. In the worker."""
    import rawpy

    try:
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            sizes = raw.sizes  # unpacks nothing, unlike every other property
            plausible.check_size(path, sizes.width, sizes.height)
            plausible.check_bytes(path, sizes.width, sizes.height, len(data))
            meta: dict[str, Any] = {"width": sizes.width, "height": sizes.height}
            if unpack:
                meta["exif"] = _known(raw.other, raw.lens)
    except (rawpy.LibRawError, NotImplementedError) as error:
        raise _refused(path, error) from None
    return meta


def _known(other: Any, lens: Any) -> dict[str, Any]:
    stamp = other.timestamp
    known = Exif(
        lens=(lens.model or "").strip(),
        exposure_time=other.shutter_speed or None,
        f_number=other.aperture or None,
        iso=other.iso_speed or None,
        focal_length_mm=other.focal_length or None,
        taken=stamp.isoformat() if stamp and stamp.year > 1970 else "",
    )
    return {name: value for name, value in asdict(known).items() if value}


def version() -> str:
    """LibRaw's version, asked in the worker; raises DecodeError where that does not run."""
    return str(worker.call(about, "LibRaw")[0]["version"])


def about(path: str) -> worker.Answer:
    """In the worker."""
    import rawpy

    return {"version": ".".join(map(str, rawpy.libraw_version))}, {}


def decode(path: str, digest: str | None = None) -> worker.Answer:
    """The counts (H, W) or (H, W, 3) and what they mean. In the worker; raises DecodeError."""
    import rawpy

    data = photo_bytes.load(path, digest)
    if sniff.is_foveon(data):
        raise DecodeError(f"{path}: {unsupported(None)}")
    structure = sniff.structure(io.BytesIO(data))
    plausible.check_structure(path, structure, data)
    if structure.dng and structure.truncated:  # LibRaw may return whatever lay in memory
        raise DecodeError(f"{path}: its image data run past the end of the file; {_COPY_AGAIN}")
    try:
        raw = _opened(path, data)
        fast = dng_jpeg.counts(structure, data)
        if fast is not None and fast.shape == (raw.sizes.raw_height, raw.sizes.raw_width):
            raw = _opened(path, dng_jpeg.hollow(structure, data))
            meta, arrays = _counts(path, raw, _visible(raw, fast))
        else:
            meta, arrays = _counts(path, raw, raw.raw_image_visible)
    except (rawpy.LibRawError, NotImplementedError) as error:
        raise _refused(path, error) from None
    lossy = plausible.is_lossy(structure)
    plausible.check_levels(path, arrays["value"], float(np.max(meta["black"])), meta["white"], lossy)
    stated = exif.tags(data).color_matrix
    meta["lossy"] = lossy or meta["white"] - float(np.min(meta["black"])) <= _EIGHT_BITS
    return meta | ({} if stated is None else {"xyz_to_camera": stated}), arrays


def _opened(path: str, data: bytes) -> Any:
    """LibRaw's view of a file of plausible size; never closed: the counts are a view that keeps it."""
    import rawpy

    raw = rawpy.RawPy()
    raw.open_buffer(io.BytesIO(data))
    plausible.check_size(path, raw.sizes.raw_width, raw.sizes.raw_height)
    plausible.check_bytes(path, raw.sizes.width, raw.sizes.height, len(data))
    return raw


def _visible(raw: Any, value: NDArray[Any]) -> NDArray[Any]:
    """A mosaic (H, W) without its masked border."""
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    return value[top : top + raw.sizes.height, left : left + raw.sizes.width]


def _counts(path: str, raw: Any, value: NDArray[Any]) -> tuple[dict[str, Any], worker.Arrays]:
    """The counts as they lie in the file, their levels and colors."""
    meta: dict[str, Any] = {"balance": _balance(raw), "xyz_to_camera": _xyz_to_camera(raw)}
    if value.ndim == 3 and value.shape[2] >= 3:
        if raw.num_colors != 3:
            raise DecodeError(f"{path}: has {raw.num_colors} colour channels where 3 are supported")
        arrays = {"value": value[..., :3]}
        black = [[float(np.mean(raw.black_level_per_channel[:3]))]]
    elif value.ndim == 2 and raw.num_colors == 1:
        arrays = {"value": np.repeat(value[..., None], 3, axis=2)}
        black = [[float(raw.black_level_per_channel[0])]]
    else:
        cfa, black = _mosaic(raw, path)
        if cfa.shape == (6, 6):
            value, cfa, black = _from_whole_block(path, value, cfa, black)
        arrays = {"value": value, "cfa": cfa}
    return meta | {"black": black, "white": _white(raw, float(np.max(black)))}, arrays


def unsupported(shape: tuple[int, ...] | None, rotated: bool = False) -> str:
    """Why a colour filter of this period (rows, columns) cannot be used, and what to do; None: there is none.

    rotated : its rows and columns run at 45° to the picture's.
    """
    if shape is None:
        what = "not in front of each pixel: it is a Foveon's layers, or sub-sampled colour"
    elif rotated:
        what = "Fujifilm's SuperCCD, turned by 45°"
    else:
        what = f"a mosaic of {'×'.join(map(str, shape))}"
    return f"its colour filter is {what}, {plausible.DEVELOP}"


def _mosaic(raw: Any, path: str) -> tuple[Bits, list[list[float]]]:
    """The colours and black levels of one period, (2, 2) or (6, 6), from the first visible pixel on."""
    pattern = raw.raw_pattern
    if pattern is None or pattern.shape not in ((2, 2), (6, 6)):
        rotated = raw.sizes.width * raw.sizes.height > raw.sizes.raw_width * raw.sizes.raw_height
        raise DecodeError(f"{path}: {unsupported(None if pattern is None else pattern.shape, rotated)}")
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    period = range(len(pattern))
    index = [[raw.raw_color(top + y, left + x) for x in period] for y in period]
    names = raw.color_desc.decode()
    letters = [[names[i] for i in row] for row in index]
    usual = {2: {"R": 1, "G": 2, "B": 1}, 6: {"R": 8, "G": 20, "B": 8}}[len(pattern)]
    if Counter(letter for row in letters for letter in row) != usual:
        raise DecodeError(f"{path}: its mosaic is {letters}, not of red, green and blue; polcap does not support it")
    cfa = np.array([["RGB".index(letter) for letter in row] for row in letters], np.uint8)
    levels = raw.black_level_per_channel  # in the order of the colour index
    return cfa, [[float(levels[i]) for i in row] for row in index]


def _from_whole_block(
    path: str, value: NDArray[Any], cfa: Bits, black: list[list[float]]
) -> tuple[NDArray[Any], Bits, list[list[float]]]:
    """An X-Trans mosaic from its first whole 3×3 block on: up to two rows and columns are dropped."""
    corner = demosaic.x_trans_corner(cfa)
    if corner is None:
        raise DecodeError(f"{path}: {unsupported((6, 6))}")
    down, right = corner
    cfa, levels = (np.roll(part, (-down, -right), (0, 1)) for part in (cfa, np.array(black)))
    return np.ascontiguousarray(value[down:, right:]), cfa, levels.tolist()


def _white(raw: Any, black: float) -> float:
    """Saturation: LibRaw's maximum, or the camera's own lower statement of it."""
    stated = [level for level in raw.camera_white_level_per_channel or () if level > black]
    lowest = min([raw.white_level, *stated])
    return float(lowest if lowest > raw.white_level / 2 else raw.white_level)


def _balance(raw: Any) -> list[float] | None:
    balance = raw.camera_whitebalance[:3]
    return [value / balance[1] for value in balance] if min(balance) > 0 else None


def _xyz_to_camera(raw: Any) -> list[list[float]] | None:
    matrix: NDArray[Any] = raw.rgb_xyz_matrix[:3]
    return matrix.tolist() if matrix.any() else None


def _refused(path: str, error: Exception) -> DecodeError:
    import rawpy

    reason = error.args[0] if error.args else type(error).__name__
    reason = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
    if isinstance(error, rawpy.LibRawFileUnsupportedError):
        return DecodeError(f"{path}: no RAW format that LibRaw knows ({reason}); is the file complete?")
    if isinstance(error, NotImplementedError):
        return DecodeError(f"{path}: a RAW layout that is not supported ({reason}); convert it to DNG")
    return DecodeError(f"{path}: truncated or damaged ({reason}); {_COPY_AGAIN}")
