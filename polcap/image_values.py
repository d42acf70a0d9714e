"""Arrays, quality bits and pixel grids: the values from which all others are built.

Shapes: K polarizer shots, E exposures of one bracket, H×W pixels (row 0 is the top, pixel centers are whole
numbers), C = 3 channels. The one channel of a monochrome sensor is repeated in all three with three times its
variance, so that sums over channels have their true variance. Arrays may be read-only memory maps: never write into
one.
"""

from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Bits = NDArray[np.uint8]
TexturePixels = NDArray[Any]  # uint8 or uint16; a share of the type's largest value
Device = Literal["cpu", "cuda", "auto"]
Bools = NDArray[np.bool_]
Indices = NDArray[np.integer[Any]]
Faces = NDArray[np.int32]  # (F, 3) vertices of triangles
NOT_IN_KEY = {"in_key": False}  # metadata of a field that cache keys ignore, because it does not change a result


class ArrayValue:
    """Base class of values with pictures: their repr shows type and shape of each array, not its numbers."""

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={_short(value)}" for name, value in vars(self).items())
        return f"{type(self).__name__}({fields})"


def _short(value: Any) -> str:
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)


class Quality(IntFlag):
    """Defects of a pixel, as bits of a uint8 map; 0: none known."""

    CLIPPED = 1  # at or near saturation in every usable exposure
    DARK = 2  # below its noise: in a merged shot below 2σ, in S0 below `stokes.dark_sigma`
    OUTSIDE = 4  # not visible in every shot after registration
    ILL_POSED = 8  # DoLP above the physical maximum, or S0 ≤ 0
    METAL = 16  # channels differ in AoLP or DoLP as on metals
    GHOST = 32  # exposures of one bracket differ by more than their noise
    ERASED = 64  # showed the board's print, which was made as dark as its ink


@dataclass(frozen=True, repr=False)
class SensorImage(ArrayValue):
    """One decoded frame, linear, black level not subtracted."""

    value: Floats | NDArray[np.uint16]  # (H, W) mosaic, or (H, W, 3) without a mosaic; counts
    black: Floats  # shape of `cfa`, by place in the mosaic; (1, C) without one; (1, 1): one for all; counts
    white: float  # counts at which the sensor saturates
    cfa: Bits | None  # (2, 2), X-Trans (6, 6), of 0 R, 1 G, 2 B; None without a mosaic
    camera_matrix: Floats | None = None  # (3, 3) camera RGB → linear Rec.709 at the camera's white balance
    white_balance: Floats | None = None  # (3,) multipliers as shot, green = 1
    lossy: bool = False  # decoded from 8 bits or a display encoding

    @property
    def superpixel(self) -> int:
        """Side of the smallest square of photosites with all colors: 2 Bayer, 3 X-Trans, 1 no mosaic."""
        return 1 if self.cfa is None else 2 if self.cfa.shape == (2, 2) else 3

    @property
    def site_px(self) -> Floats:
        """Mean position (3, 2) x, y of each color relative to the superpixel's middle [superpixels]; 0: no mosaic."""
        if self.cfa is None:
            return np.zeros((3, 2))
        side = self.superpixel
        square = self.cfa[:side, :side]
        return np.array([(np.argwhere(square == color).mean(axis=0)[::-1] + 0.5) / side - 0.5 for color in range(3)])


@dataclass(frozen=True)
class View:
    """A pinhole camera on one pixel grid: focal length, principal point, scale."""

    focal: float  # px of this grid
    center: tuple[float, float]  # (x, y) px of this grid
    scale: float  # visible RAW pixels per pixel of this grid (2 after superpixel binning)
    origin: tuple[float, float] = (0.0, 0.0)  # position of this grid's pixel (0, 0) before cropping
    known: bool = True  # False: the focal length is an assumption

    @property
    def intrinsic(self) -> Floats:
        """Matrix (3, 3) from points of the frame x right, y down, z ahead to homogeneous pixels."""
        return np.array([[self.focal, 0, self.center[0]], [0, self.focal, self.center[1]], [0, 0, 1]])


@dataclass(frozen=True)
class Distortion:
    """Radial lens distortion (k₁, k₂) on one pixel grid; see optics/distortion.py."""

    focal: float  # px of this grid
    center: tuple[float, float]  # (x, y) px of this grid, the principal point
    k1: float
    k2: float


@dataclass(frozen=True, repr=False)
class MaskedImage(ArrayValue):
    """An image with radiance, variance and quality bits of each pixel."""

    value: Floats  # (H, W, 3) sensor white at the reference exposure = 1; may be negative
    variance: Floats  # (H, W, 3)
    quality: Bits  # (H, W) Quality bits


@dataclass(frozen=True, repr=False)
class Mosaic(ArrayValue):
    """A merged shot before demosaicing: each photosite has one color."""

    value: Floats  # (2H, 2W) float16, sensor white at the reference exposure = 1
    cfa: Bits  # (2, 2) of 0 R, 1 G, 2 B
