"""In: the frames of a capture. Out: their signals, a plane per channel, block by block; decoded ahead of use."""

import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Decode, Floats, Frame, SensorImage, Shot
from polcap.optics import sensor
from polcap.stages.hdr.budget import Budget

Bools = NDArray[np.bool_]

_ROWS = 64  # a block of one channel of a 24 MP picture then fits a core's own cache
_AHEAD = 2  # frames decoded beside the merge, each in a process of its own


class Signals(Protocol):
    """Linear signals of one frame, black = 0 and white = 1, and which of its pixels can be believed."""

    @property
    def usable(self) -> Bools:
        """(H, W)."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """C, H, W."""
        ...

    def rows(self, rows: slice) -> Floats:
        """Some rows, (C, h, W) float32: a new array, or a view that must not be written to."""
        ...


@dataclass(frozen=True)
class Planes:
    """Signals that are there already."""

    value: Floats  # (C, H, W) float32
    usable: Bools

    @property
    def shape(self) -> tuple[int, int, int]:
        channels, height, width = self.value.shape
        return channels, height, width

    def rows(self, rows: slice) -> Floats:
        """As `Signals.rows`: a view, (C, h, W)."""
        return self.value[:, rows]


@dataclass(frozen=True)
class Quads:
    """Signals of a binned mosaic, made of the counts when asked for: a third of the memory of `Planes`."""

    image: SensorImage
    usable: Bools

    @property
    def shape(self) -> tuple[int, int, int]:
        height, width = self.image.value.shape
        return 3, height // self.image.superpixel, width // self.image.superpixel

    def rows(self, rows: slice) -> Floats:
        """As `optics.sensor.signal`, (C, h, W), to the bit."""
        start, stop, _ = rows.indices(self.shape[1])
        out = np.empty((3, stop - start, self.shape[2]), np.float32)
        self.into(rows, out)
        return out

    def into(self, rows: slice, out: Floats) -> None:
        """The same, written to `out` (C, h, W)."""
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
    """Signals of a decoded frame, and which of its pixels can be believed.

    Parameters
    ----------
    image
        The counts.
    clip
        As in the stage's settings [white level].
    full
        Interpolate a mosaic instead of binning it by superpixels.
    planes_bytes
        How large binned planes may be; larger ones are made of the counts when they are asked for.
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
    """Rows to read (with a halo, cut at the border), the wanted part of what was read, and where it goes."""
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        start = max(top - halo, 0)
        yield (
            slice(start, min(bottom + halo, height)),
            slice(top - start, bottom - start),
            slice(top, bottom),
        )


class Reader:
    """Decoded frames, the last few kept, the next few under way."""

    def __init__(self, coming: Iterable[Frame], decode: Decode) -> None:
        """`coming`: the frames in the order in which they will be asked for."""
        self.lossy = False
        self._decode = decode
        self._channels = 0  # of the first frame
        self.budget = Budget()
        self._coming = deque(coming)
        self._held: OrderedDict[int, SensorImage] = OrderedDict()
        self._pool = ThreadPoolExecutor(_AHEAD)
        self._decoding: dict[int, Future[SensorImage]] = {}

    def __call__(self, frame: Frame) -> SensorImage:
        """Raises DecodeError."""
        if id(frame) not in self._held:
            under_way = self._decoding.pop(id(frame), None) or self._pool.submit(self._decode, frame)
            image = under_way.result()
            room = max(1, self.budget.frames // max(image.value.nbytes, 1))
            while len(self._held) >= room:
                self._held.popitem(last=False)
            self._held[id(frame)] = image
            self._look_ahead(frame, room)
        self._held.move_to_end(id(frame))
        image = self._held[id(frame)]
        self.lossy |= image.lossy
        return image

    def signals(self, shot: Shot, e: int, clip: float, full: bool = False) -> Signals:
        """Signals of a frame; as planes where there is room for those of its whole shot.

        Parameters
        ----------
        shot
            The bracket.
        e
            Index of the frame in it.
        clip, full
            As `signals` has them.
        """
        found = signals(self(shot.frames[e]), clip, full, self.budget.planes / len(shot.frames))
        self._channels = self._channels or found.shape[0]
        if not isinstance(found, Planes) or found.shape[0] == self._channels:
            return found
        even = np.ptp(found.value) == 0  # all clipped: of how many channels it is the others say
        if even or found.shape[0] == 1:  # a grey picture among coloured ones
            return Planes(np.repeat(found.value[:1], self._channels, axis=0), found.usable)
        return found

    def forget(self, frames: Iterable[Frame]) -> None:
        """These are not needed any more."""
        for frame in frames:
            self._held.pop(id(frame), None)
        self._look_ahead(None, len(self._held) + 2 * _AHEAD)

    def close(self) -> None:
        """Wait for nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _look_ahead(self, now: Frame | None, room: int) -> None:
        """Have the next frames decoded, as long as they and those held have room."""
        self._coming = deque(frame for frame in self._coming if frame is not now)
        while self._coming and len(self._decoding) < _AHEAD and len(self._held) + len(self._decoding) < room:
            following = self._coming.popleft()
            if id(following) not in self._held:
                self._decoding[id(following)] = self._pool.submit(self._decode, following)


def tile_means(picture: Signals, side: int) -> Floats:
    """Means (rows, columns, C) float32 over tiles of side × side px; what is left of a tile is dropped."""
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
