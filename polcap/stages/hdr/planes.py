"""Reads frames as linear signals, channel by channel: decoding in advance, binning, resampling, memory limits.

A limit on memory (`--memory`, `ulimit -d`) decides how much stays in memory. With little room, frames are decoded
again for every pass, and planes are computed block by block. The pixels are the same.
"""

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np

from polcap import parallel
from polcap.capture_values import Decode, Frame
from polcap.errors import CaptureError, SettingError
from polcap.image_values import Bools, Floats, SensorImage
from polcap.optics import sensor
from polcap.optics.projection import coordinates
from polcap.optics.resize import block_means
from polcap.stage_values import BlackError

_ROWS = 64  # of a block; one channel of such a block of a 24 MP picture fits a core's cache
_AHEAD = 2  # frames decoded ahead of the merge, in as many threads; each waits for a decoding process
_PLANES_BYTES = 400_000_000  # limit for a shot's signals; beyond, they are computed again for every pass
_HELD_BYTES = 1_100_000_000  # limit for decoded frames; others are decoded again when needed
_WORK_BYTES = 60  # per pixel, for the first estimate, registration, masks and blocks
_MOSAIC_BYTES = 8  # per pixel: four photosites of the first shot, half floats
_FRACTIONS = 32  # steps per pixel in the table of cv2's Lanczos kernel


@dataclass(frozen=True)
class Signals:
    """Linear signals of one frame, black = 0 and white = 1, read block by block, and its usable pixels."""

    shape: tuple[int, int, int]  # C, H, W
    usable: Bools  # (H, W)
    clip: float  # pixels are clipped from this signal on
    rows: Callable[[slice], Floats]  # some rows (C, h, W) float32; the result must not be changed


def in_memory(value: Floats, usable: Bools, clip: float) -> Signals:
    """Wrap an array (C, H, W) float32 as `Signals` that are held in memory."""
    channels, height, width = value.shape
    return Signals((channels, height, width), usable, clip, lambda rows: value[:, rows])


def signals(image: SensorImage, clip: float, full: bool = False, planes_bytes: float = math.inf) -> Signals:
    """Linear signals of a decoded frame; clipped pixels are not usable, with `clip` as in `sensor.clip_count`.

    A mosaic is binned by superpixels, or interpolated with `full`. Binned signals of more than `planes_bytes` are
    computed from the counts whenever rows are read, in a third of the memory.
    """
    count, black = sensor.clip_count(image, clip), float(image.black.mean())
    usable, level = sensor.below(image, count, full), (count - black) / (image.white - black)
    if image.cfa is None or full:
        return in_memory(planar(sensor.signal(image, full)), usable, level)
    shape = (3, *usable.shape)
    read = partial(sensor.binned_planes, image)
    if 4 * math.prod(shape) > planes_bytes:
        return Signals(shape, usable, level, read)
    value = np.empty(shape, np.float32)

    def bin_rows(rows: slice) -> None:
        value[:, rows] = read(rows)

    parallel.results(partial(bin_rows, rows) for rows, _, _ in blocks(usable.shape[0]))
    return in_memory(value, usable, level)


def planar(picture: Floats) -> Floats:
    """Reorder a picture to planes: (H, W, C) → (C, H, W), contiguous."""
    return np.ascontiguousarray(np.moveaxis(picture, -1, 0))


def blocks(height: int, halo: int = 0, rows: int = _ROWS) -> Iterator[tuple[slice, slice, slice]]:
    """Divide a picture into blocks of rows, each read with `halo` more rows on both sides for filters.

    Yields the rows to read, the rows of the block within these, and the rows of the block in the picture.
    """
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        start = max(top - halo, 0)
        yield slice(start, min(bottom + halo, height)), slice(top - start, bottom - start), slice(top, bottom)


def tile_means(picture: Signals, side: int) -> Floats:
    """Means (rows, columns, C) float32 over tiles of side × side px; incomplete tiles are dropped."""
    _, height, width = picture.shape
    parts = [picture.rows(rows) for rows, _, _ in blocks(height // side * side, rows=math.ceil(_ROWS / side) * side)]
    means = [np.stack([block_means(plane, side) for plane in part], axis=-1) for part in parts]
    return np.concatenate([np.zeros((0, width // side, picture.shape[0]), np.float32), *means])


def resample(signals: Signals, matrix: Floats) -> tuple[Signals, Floats]:
    """Resample a frame on the reference frame's grid by Lanczos interpolation.

    matrix (3, 3) maps reference px → frame px. Also returns the factor (H, W) on the noise variance.
    """
    _, h, w = signals.shape
    inverse = cv2.WARP_INVERSE_MAP
    options = {"flags": inverse | cv2.INTER_LANCZOS4, "borderMode": cv2.BORDER_REPLICATE}
    value = np.stack([cv2.warpPerspective(plane, matrix, (w, h), **options) for plane in signals.rows(slice(None))])
    # a pixel is usable if no clipped pixel and no border is within the main lobes of the kernel
    inner = cv2.erode(signals.usable.view(np.uint8) * 255, np.ones((5, 5), np.uint8), borderValue=0)
    usable = cv2.warpPerspective(inner, matrix, (w, h), flags=inverse | cv2.INTER_LINEAR, borderValue=0) == 255
    gain = np.empty((h, w), np.float32)
    table = _kernel_gain()
    x = np.arange(w, dtype=np.float32)
    for rows, _, _ in blocks(h):
        y = np.arange(h, dtype=np.float32)[rows, None]
        px, py = coordinates(matrix, x, y)
        gain[rows] = table[((px - np.floor(px)) * _FRACTIONS + 0.5).astype(np.int8)]
        gain[rows] *= table[((py - np.floor(py)) * _FRACTIONS + 0.5).astype(np.int8)]
    return in_memory(value, usable, signals.clip), gain


@lru_cache(maxsize=1)
def _kernel_gain() -> Floats:
    """Noise gain of Lanczos resampling: sums (33,) of squared kernel weights at fractions 0, 1/32 … 1 of a pixel."""
    impulse = np.zeros((17, 33), np.float32)
    impulse[:, 16] = 1
    x = np.arange(33, dtype=np.float32)[None] + np.arange(33, dtype=np.float32)[:, None] / 32
    weights = cv2.remap(impulse, x, np.full_like(x, 8), cv2.INTER_LANCZOS4)  # row i: at the fraction i/32
    return np.asarray(np.sum(weights.astype(np.float64) ** 2, axis=1), np.float32)


@dataclass(frozen=True)
class MemoryPlan:
    """Memory that the merge may use for signals and decoded frames, bytes."""

    planes: int = _PLANES_BYTES  # of one frame's signals
    frames: int = _HELD_BYTES  # of all decoded frames


def plan_memory(shots: int, frames: int, pixels: int, frame_bytes: int) -> MemoryPlan:
    """Divide the memory limit between the signals and the decoded frames of a merge.

    There are `shots` of `frames` frames each. A decoded frame has `frame_bytes`; the merged picture has `pixels`.

    Raises SettingError: the merge needs more than the limit.
    """
    used, limit = process_memory()
    if limit is None:
        return MemoryPlan(_PLANES_BYTES // frames)
    number = np.dtype(np.float32).itemsize  # bytes; a pixel has 3 values, 3 variances and a byte of quality
    stack = pixels * (shots * (6 * number + 1) + _MOSAIC_BYTES)
    one_shot = frames * (frame_bytes + pixels) + pixels * _WORK_BYTES
    remaining = limit - used - stack - one_shot
    if remaining < 0:
        raise SettingError(
            f"--memory {limit / 1e9:.3g}: merging {shots} × {frames} frames of {pixels / 1e6:.3g} million pixels "
            f"needs {(limit - remaining) / 1e9:.2f} GB at least; raise it, or leave it out"
        )
    planes = 3 * number * pixels * frames
    held = min(_PLANES_BYTES, remaining) if planes <= remaining else 0
    return MemoryPlan(held // frames, min(_HELD_BYTES, remaining - min(planes, held)))


def process_memory() -> tuple[int, int | None]:
    """Private, writable memory of this process and its limit [bytes]; None without a limit."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):  # another system
        return 0, None
    limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    return used, None if limit == resource.RLIM_INFINITY else limit


class Reader:
    """Decodes frames in advance; the last few frames stay in memory."""

    def __init__(self, coming: Iterable[Frame], decode: Decode, clip: float) -> None:
        """Frames in the order in which they will be read; `clip` is as in `sensor.clip_count`."""
        self._clip = clip
        self._decode = decode
        self.lossy = False
        self.black = BlackError(np.zeros(1))
        self.plan = MemoryPlan()
        self._channels = 0  # of the first frame
        self._coming = deque(coming)
        self._held: OrderedDict[int, SensorImage] = OrderedDict()
        self._pool = ThreadPoolExecutor(_AHEAD)
        self._decoding: dict[int, Future[SensorImage]] = {}

    def __call__(self, frame: Frame) -> SensorImage:
        """Decode a frame, or return it from memory; raises DecodeError."""
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
        return sensor.with_black_error(image, self.black.error) if self.black.corrected else image

    def signals(self, frame: Frame, full: bool = False) -> Signals:
        """Linear signals of a frame, with the same channels as the first frame read."""
        found = signals(self(frame), self._clip, full, self.plan.planes)
        self._channels = self._channels or found.shape[0]
        if found.shape[0] == self._channels:
            return found
        value = found.rows(slice(None))
        uniform = np.ptp(value) == 0  # fully clipped: its number of channels is that of the other frames
        if uniform or len(value) == 1:  # a grey picture among colored ones
            return in_memory(np.repeat(value[:1], self._channels, axis=0), found.usable, found.clip)
        return found

    def forget(self, frames: Iterable[Frame]) -> None:
        """Free frames that are no longer needed."""
        for frame in frames:
            self._held.pop(id(frame), None)
        self._look_ahead(None, len(self._held) + 2 * _AHEAD)

    def close(self) -> None:
        """Stop decoding in advance."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _look_ahead(self, current: Frame | None, room: int) -> None:
        """Start to decode the next frames but `current`, as many as fit into memory for `room` frames."""
        self._coming = deque(frame for frame in self._coming if frame is not current)
        while self._coming and len(self._decoding) < _AHEAD and len(self._held) + len(self._decoding) < room:
            following = self._coming.popleft()
            if id(following) not in self._held:
                self._decoding[id(following)] = self._pool.submit(self._decode, following)


def check_size(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raise CaptureError if the frame `name` has another shape (C, H, W) than the frames before it."""
    if shape != expected:
        a, b = (f"{s[2]}×{s[1]}×{s[0]}" for s in (shape, expected))
        raise CaptureError(f"{name} is {a}, the frames before it {b} [px × px × channels]: use one camera")
