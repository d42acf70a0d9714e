"""Reduces a decoded frame for `polcap check`: a small picture, clipped shares, and tiles at full size.

It runs in the decoding child process, so that only small arrays are sent back.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, SensorImage
from polcap.optics import sensor, sharpness
from polcap.optics.resize import block_means

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class ReducedFrame:
    """A reduced frame."""

    picture: SensorImage  # (h, w, 3) means of blocks, black 0, white 1; 1 for partly clipped blocks
    clipped: Floats  # (h, w) share of each block that is clipped
    tiles: sharpness.Tiles


def first(image: SensorImage, clip: float, most_pixels: float) -> tuple[dict[str, Any], Arrays]:
    """`take` for the first frame, which determines the reduction of a capture and the corners of its tiles.

    Counts from `clip` [white level] on are clipped. The first result also has `times`, merged pixels per block side,
    and `superpixel`, RAW pixels per merged pixel; the arrays also have `corners` (T, 2) px of the tiles.
    """
    side = image.superpixel
    pixels = (image.value.shape[0] // side) * (image.value.shape[1] // side)
    times = max(1, int(np.ceil(np.sqrt(pixels / most_pixels))))
    corners = sharpness.places(image, clip)
    meta, arrays = take(image, clip, times, corners.tolist())
    arrays["corners"] = corners
    return meta | {"times": times, "superpixel": side}, arrays


def take(image: SensorImage, clip: float, times: int, corners: list[list[int]]) -> tuple[dict[str, Any], Arrays]:
    """The parts of a `ReducedFrame`: blocks of `times` merged pixels a side, tiles at `corners` (T, 2) px."""
    shares = block_means((~sensor.usable(image, clip)).astype(np.float32), times)
    value = _means(image, times)
    value[shares > 0] = 1  # so that the stages exclude partly clipped pixels
    tiles = sharpness.take(image, np.asarray(corners, np.int64).reshape(-1, 2), clip)
    arrays: Arrays = {"value": value, "clipped": shares, "light": tiles.light, "usable": tiles.usable}
    if image.camera_matrix is not None:
        arrays["camera_matrix"] = image.camera_matrix
    if image.white_balance is not None:
        arrays["white_balance"] = image.white_balance
    return {"lossy": image.lossy}, arrays


def joined(meta: dict[str, Any], arrays: Arrays) -> ReducedFrame:
    """The `ReducedFrame` of the parts (h, w) from `take`."""
    picture = SensorImage(
        value=arrays["value"],
        black=np.zeros((1, 1)),
        white=1.0,
        cfa=None,
        camera_matrix=arrays.get("camera_matrix"),
        white_balance=arrays.get("white_balance"),
        lossy=meta["lossy"],
    )
    return ReducedFrame(picture, arrays["clipped"], sharpness.Tiles(arrays["light"], arrays["usable"]))


def _means(image: SensorImage, times: int) -> Floats:
    """Signal (h, w, 3) over blocks of times × times merged pixels."""
    if image.superpixel != 2 or image.cfa is None or image.value.dtype != np.uint16:
        signal = sensor.signal(image)
        return block_means(np.repeat(signal, 3, axis=2) if signal.shape[2] == 1 else signal, times)
    sites = _sums(image.value.astype(np.uint16, copy=False), times)  # (2, 2, h, w)
    out = np.empty((*sites.shape[2:], 3), np.float32)
    black = np.broadcast_to(image.black, (2, 2))
    span = image.white - float(image.black.mean())
    for color in range(3):
        here = image.cfa == color
        out[..., color] = (sites[here].mean(0) / times**2 - black[here].mean()) / span
    return out


def _sums(mosaic: NDArray[np.uint16], times: int) -> NDArray[np.uint32]:
    """Sums (2, 2, h, w) of the counts of each CFA phase over blocks of times × times quads."""
    height, width = (side // (2 * times) for side in mosaic.shape)
    rows = mosaic[: 2 * times * height, : 2 * times * width].reshape(height, times, 2, -1)
    down = np.zeros((height, 2, rows.shape[-1]), np.uint32)
    for n in range(times):
        down += rows[:, n]
    across = down.reshape(height, 2, width, times, 2)
    out = np.zeros((2, 2, height, width), np.uint32)
    for n in range(times):
        out += across[:, :, :, n].transpose(1, 3, 0, 2)
    return out
