"""Reads frames as planes of linear signals: decoding ahead, binning, resampling, limits of memory.

A limit on memory (`--memory`, `ulimit -d`) decides how much stays in memory. With little room, frames are decoded
again for every pass, and planes are computed block by block. The pixels are the same.
"""

import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.errors import CaptureError, SettingError
from polcap.images import Decode, Floats, Frame, SensorImage, Shot
from polcap.optics import sensor
from polcap.optics.projection import coordinates

Bools = NDArray[np.bool_]

_ROWS = 64  # of a block: one channel of a 24 MP picture then fits a core's cache
_AHEAD = 2  # frames decoded ahead of the merge; each thread waits for a decoding process
_PLANES_BYTES = 400_000_000  # most for a shot's signals; with more they are computed again for every pass
_HELD_BYTES = 1_100_000_000  # most for decoded frames; others are decoded again when needed
_WORK_BYTES = 60  # per pixel, for the first estimate, registration, masks and blocks
_FRACTIONS = 32  # steps per pixel in the table of cv2's Lanczos kernel


class Signals(Protocol):
    """Linear signals of one frame, black = 0 and white = 1, and its usable pixels."""

    @property
    def usable(self) -> Bools:
        """(H, W)."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """C, H, W."""
        ...

    def rows(self, rows: slice) -> Floats:
        """Some rows (C, h, W) float32; a new array, or a view that must not be changed."""
        ...


@dataclass(frozen=True)
class Planes:
    """Signals in memory."""

    value: Floats  # (C, H, W) float32
    usable: Bools

    @property
    def shape(self) -> tuple[int, int, int]:
        channels, height, width = self.value.shape
        return channels, height, width

    def rows(self, rows: slice) -> Floats:
        """Some rows (C, h, W), as a view."""
        return self.value[:, rows]


@dataclass(frozen=True)
class Quads:
    """Signals of a binned mosaic, computed from its counts when read: a third of the memory of `Planes`."""

    image: SensorImage
    usable: Bools

    @property
    def shape(self) -> tuple[int, int, int]:
        height, width = self.image.value.shape
        return 3, height // self.image.superpixel, width // self.image.superpixel

    def rows(self, rows: slice) -> Floats:
        """Some rows (C, h, W), identical to `optics.sensor.signal`."""
        start, stop, _ = rows.indices(self.shape[1])
        out = np.empty((3, stop - start, self.shape[2]), np.float32)
        self.into(rows, out)
        return out

    def into(self, rows: slice, out: Floats) -> None:
        """Write some rows to `out` (C, h, W)."""
        image = self.image
        assert image.cfa is not None
        _, height, width = self.shape
        start, stop, _ = rows.indices(height)
        if image.superpixel == 3:
            cfa = np.roll(image.cfa, -3 * start % 6, axis=0)
            out[:] = np.moveaxis(sensor.signal(replace(image, value=image.value[3 * start : 3 * stop], cfa=cfa)), -1, 0)
            return
        black = np.broadcast_to(image.black, (2, 2))
        span = np.float32(image.white - float(image.black.mean()))
        for color, plane in enumerate(out):
            sites = [site for site in np.ndindex(2, 2) if image.cfa[site] == color]
            for n, (i, j) in enumerate(sites):
                site = image.value[2 * start + i : 2 * stop : 2, j : 2 * width : 2]
                if n == 0:
                    plane[:] = site
                else:
                    plane += site
            if len(sites) > 1:
                plane *= np.float32(1 / len(sites))
            plane -= np.float32(black[image.cfa == color].mean())
            plane /= span


def signals(image: SensorImage, clip: float, full: bool = False, planes_bytes: float = math.inf) -> Signals:
    """Signals of a decoded frame; pixels with counts from `clip` [white level] on are not usable.

    A mosaic is binned by superpixels, or interpolated with `full`. Above `planes_bytes` the result is `Quads`.
    """
    usable = sensor.usable(image, clip, full)
    if image.cfa is None or full:
        return Planes(planar(sensor.signal(image, full)), usable)
    quads = Quads(image, usable)
    channels, height, width = quads.shape
    if 4 * channels * height * width > planes_bytes:
        return quads
    value = np.empty(quads.shape, np.float32)
    parallel.results(partial(quads.into, rows, value[:, rows]) for rows, _, _ in blocks(height))
    return Planes(value, usable)


def planar(picture: Floats) -> Floats:
    """(H, W, C) → (C, H, W), contiguous."""
    return np.ascontiguousarray(np.moveaxis(picture, -1, 0))


def blocks(height: int, halo: int = 0, rows: int = _ROWS) -> Iterator[tuple[slice, slice, slice]]:
    """Blocks of rows: the rows to read, with a halo; their part without the halo; the picture's rows of that part."""
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        start = max(top - halo, 0)
        yield (
            slice(start, min(bottom + halo, height)),
            slice(top - start, bottom - start),
            slice(top, bottom),
        )


def tile_means(picture: Signals, side: int) -> Floats:
    """Means (rows, columns, C) float32 over tiles of side × side px; incomplete tiles are dropped."""
    channels, height, width = picture.shape
    down, across = height // side, width // side
    out = np.zeros((down, across, channels), np.float32)
    per_block = math.ceil(_ROWS / side)
    for top in range(0, down, per_block):
        bottom = min(top + per_block, down)
        part = picture.rows(slice(top * side, bottom * side))
        for c in range(channels):
            whole = part[c, :, : across * side]
            out[top:bottom, :, c] = cv2.resize(whole, (across, bottom - top), interpolation=cv2.INTER_AREA)
    return out


def resample(signals: Signals, matrix: Floats) -> tuple[Planes, Floats]:
    """Resample a frame on the reference frame's grid by Lanczos interpolation.

    matrix (3, 3) maps reference px → frame px. Also returns the factor (H, W) on the noise variance.
    """
    _, h, w = signals.shape
    inverse = cv2.WARP_INVERSE_MAP
    value = np.stack(
        [
            cv2.warpPerspective(
                plane, matrix, (w, h), flags=inverse | cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
            )
            for plane in signals.rows(slice(0, h))
        ]
    )
    # unusable if a clipped pixel or the border is within the main lobes of the kernel
    inner = cv2.erode(signals.usable.view(np.uint8) * 255, np.ones((5, 5), np.uint8), borderValue=0)
    seen = cv2.warpPerspective(inner, matrix, (w, h), flags=inverse | cv2.INTER_LINEAR, borderValue=0) == 255
    gain = np.empty((h, w), np.float32)
    table = _kernel_gain()
    x = np.arange(w, dtype=np.float32)
    for rows, _, _ in blocks(h):
        y = np.arange(h, dtype=np.float32)[rows, None]
        px, py = coordinates(matrix, x, y)
        gain[rows] = table[((px - np.floor(px)) * _FRACTIONS + 0.5).astype(np.int8)]
        gain[rows] *= table[((py - np.floor(py)) * _FRACTIONS + 0.5).astype(np.int8)]
    return Planes(value, seen), gain


@lru_cache(maxsize=1)
def _kernel_gain() -> Floats:
    """Sums (33,) of the squared weights of cv2's Lanczos kernel at fractions 0, 1/32 … 1 of a pixel."""
    impulse = np.zeros((17, 33), np.float32)
    impulse[:, 16] = 1
    x = np.arange(33, dtype=np.float32)[None] + np.arange(33, dtype=np.float32)[:, None] / 32
    row = cv2.remap(impulse, x, np.full_like(x, 8), cv2.INTER_LANCZOS4)
    return np.asarray(np.sum(row.astype(np.float64) ** 2, axis=1), np.float32)


@dataclass(frozen=True)
class MemoryPlan:
    """Memory that the merge may use for signals and decoded frames, bytes."""

    planes: int = _PLANES_BYTES
    frames: int = _HELD_BYTES


def plan_memory(shots: int, frames: int, pixels: int, frame_bytes: int) -> MemoryPlan:
    """Divide the memory under the limit: for `shots` of `frames` each, `frame_bytes` decoded, `pixels` merged.

    Raises
    ------
    SettingError
        The merge needs more than the limit.
    """
    taken, limit = process_memory()
    if limit is None:
        return MemoryPlan()
    sample = np.dtype(np.float32).itemsize
    stack = pixels * shots * (6 * sample + 1)
    one_shot = frames * (frame_bytes + pixels) + pixels * _WORK_BYTES
    left = limit - taken - stack - one_shot
    if left < 0:
        raise SettingError(
            f"--memory {limit / 1e9:.3g}: merging {shots} × {frames} frames of {pixels / 1e6:.3g} million pixels "
            f"needs {(limit - left) / 1e9:.2f} GB at least; raise it, or leave it out"
        )
    planes = 3 * sample * pixels * frames
    held = min(_PLANES_BYTES, left) if planes <= left else 0
    return MemoryPlan(held, min(_HELD_BYTES, left - min(planes, held)))


def process_memory() -> tuple[int, int | None]:
    """Private, writable memory of this process and its limit [bytes]; None without a limit."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            taken = int(file.read().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):  # another system
        return 0, None
    limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    return taken, None if limit == resource.RLIM_INFINITY else limit


class Reader:
    """Decodes frames: the last few stay in memory, the next few are decoded ahead."""

    def __init__(self, coming: Iterable[Frame], decode: Decode, clip: float) -> None:
        """Frames in the order in which they will be read; counts from `clip` [white level] on are clipped."""
        self.clip = clip
        self._decode = decode
        self.lossy = False
        self.plan = MemoryPlan()
        self._channels = 0  # of the first frame
        self._coming = deque(coming)
        self._held: OrderedDict[int, SensorImage] = OrderedDict()
        self._pool = ThreadPoolExecutor(_AHEAD)
        self._decoding: dict[int, Future[SensorImage]] = {}

    def __call__(self, frame: Frame) -> SensorImage:
        """The decoded frame; raises DecodeError."""
        if id(frame) not in self._held:
            decoding = self._decoding.pop(id(frame), None) or self._pool.submit(self._decode, frame)
            image = decoding.result()
            room = max(1, self.plan.frames // max(image.value.nbytes, 1))
            while len(self._held) >= room:
                self._held.popitem(last=False)
            self._held[id(frame)] = image
            self._look_ahead(frame, room)
        self._held.move_to_end(id(frame))
        image = self._held[id(frame)]
        self.lossy |= image.lossy
        return image

    def signals(self, shot: Shot, e: int, full: bool = False) -> Signals:
        """Signals of frame e of a bracket, with the channels of the first frame read."""
        found = signals(self(shot.frames[e]), self.clip, full, self.plan.planes / len(shot.frames))
        self._channels = self._channels or found.shape[0]
        if not isinstance(found, Planes) or found.shape[0] == self._channels:
            return found
        uniform = np.ptp(found.value) == 0  # fully clipped: its number of channels is that of the other frames
        if uniform or found.shape[0] == 1:  # a grey picture among colored ones
            return Planes(np.repeat(found.value[:1], self._channels, axis=0), found.usable)
        return found

    def forget(self, frames: Iterable[Frame]) -> None:
        """Free frames that are no longer needed."""
        for frame in frames:
            self._held.pop(id(frame), None)
        self._look_ahead(None, len(self._held) + 2 * _AHEAD)

    def close(self) -> None:
        """Stop decoding ahead."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _look_ahead(self, now: Frame | None, room: int) -> None:
        """Start to decode the next frames while they and those in memory fit."""
        self._coming = deque(frame for frame in self._coming if frame is not now)
        while self._coming and len(self._decoding) < _AHEAD and len(self._held) + len(self._decoding) < room:
            following = self._coming.popleft()
            if id(following) not in self._held:
                self._decoding[id(following)] = self._pool.submit(self._decode, following)


def same_size(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raise CaptureError for a frame (C, H, W) with another shape than the frames before it."""
    if shape != expected:
        a, b = (f"{s[2]}×{s[1]}×{s[0]}" for s in (shape, expected))
        raise CaptureError(f"{name} is {a}, the frames before it {b} [px × px × channels]: use one camera")
