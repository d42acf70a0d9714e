"""Simulated camera: lens distortion, color mosaic, noise, clipping and the DNG file.

References
----------
Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010, §3.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import dng_writer
from polcap.image_values import Bits, Floats, View
from polcap.optics.color import REC709_TO_XYZ

SENSOR_WIDTH_MM = 36.0
Bend = Annotated[float, Meta(ge=-1, le=1)]  # k₁ or k₂ of the lens
_RADII = 20001  # radii in the table of a lens
COLOR_MATRIX = (0.87, -0.27, -0.075, -0.44, 1.23, 0.235, -0.09, 0.19, 0.69)  # XYZ → camera, row by row


class Sensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Properties of one photosite of the simulated sensor at base ISO: full well, read noise, black, white."""

    full_well: Annotated[float, Meta(gt=0, le=1e9, description="at the white level [e⁻]")] = 30000.0
    read_noise: Annotated[float, Meta(ge=0, le=1e6, description="1σ [e⁻]")] = 3.0
    black: Annotated[int, Meta(ge=0, lt=65535, description="black level [counts]")] = 512
    white: Annotated[int, Meta(gt=0, le=65535, description="white level [counts]")] = 15871


def pinhole(focal_mm: float, width: int, height: int) -> View:
    """View (focal length, principal point) of a camera without distortion, on its own RAW pixels."""
    return View(focal_mm / SENSOR_WIDTH_MM * width, ((width - 1) / 2, (height - 1) / 2), scale=1)


def pixel_samples(height: int, width: int, side: int) -> Iterator[tuple[Floats, Floats]]:
    """Yield positions x, y (H, W) of `side`² samples per pixel, one sample of every pixel at a time."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    offsets = (np.arange(side) + 0.5) / side - 0.5
    for dy, dx in product(offsets, repeat=2):
        yield x + dx, y + dy


def undistort(view: View, bend: tuple[float, float], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Convert pixels x, y of a distorting lens to pixels of the pinhole camera `view` that see the same points.

    `bend` is (k₁, k₂). A ray at an angle of tangent t to the optical axis reaches the sensor at the radius
    f · (t + k₁ t³ + k₂ t⁵). The inverse is interpolated in a fine table of this radius.
    """
    if not any(bend):
        return x, y
    right, down = x - view.center[0], y - view.center[1]
    radius = np.hypot(right, down) / view.focal
    tangent = np.linspace(0, 1.5 * radius.max() + 0.01, _RADII)  # beyond the corners
    distorted = tangent + bend[0] * tangent**3 + bend[1] * tangent**5
    rising = np.concatenate([[True], np.maximum.accumulate(distorted)[:-1] < distorted[1:]])
    true = np.interp(radius, distorted[rising], tangent[rising])
    share = np.where(radius > 1e-9, true / np.maximum(radius, 1e-9), 1.0)
    return view.center[0] + right * share, view.center[1] + down * share


def rec709_to_camera(color_matrix: Sequence[float]) -> Floats:
    """Matrix (3, 3) from linear Rec.709 to camera channels, scaled so that white has 1 in green.

    `color_matrix` (9) converts XYZ to camera channels, as in a DNG.
    """
    matrix = np.reshape(color_matrix, (3, 3)) @ REC709_TO_XYZ
    return np.asarray(matrix / matrix[1].sum())


def mosaic(image: Floats, cfa: Bits) -> Floats:
    """Sample an image (H, W, 3) through a color filter array cfa (n, n) of 0 R, 1 G, 2 B; returns (H, W)."""
    out = np.empty(image.shape[:2], image.dtype)
    period = len(cfa)
    for row, column in np.ndindex(period, period):
        out[row::period, column::period] = image[row::period, column::period, cfa[row, column]]
    return out


def expose(radiance: Floats, sensor: Sensor, amplification: float, random: np.random.Generator) -> NDArray[np.uint16]:
    """Simulate the sensor: noisy counts of a mosaic (H, W) of radiance; a radiance of 1 fills the well.

    Photon noise is Poisson, read noise is Gaussian. The well saturates; counts are rounded and clipped to 0…white.
    `amplification` is ISO/100.
    """
    electrons: NDArray[Any] = random.poisson(np.maximum(radiance, 0.0) * sensor.full_well).astype(np.float64)
    electrons = np.minimum(electrons, sensor.full_well) + random.normal(0.0, sensor.read_noise, radiance.shape)
    counts = sensor.black + electrons * amplification * (sensor.white - sensor.black) / sensor.full_well
    return np.clip(np.rint(counts), 0, sensor.white).astype(np.uint16)


def write_dng(
    path: Path, counts: NDArray[np.uint16], sensor: Sensor, cfa: Bits, color_matrix: Sequence[float], exif: Exif
) -> None:
    """Write counts (H, W) as a DNG with the levels, filters and colors of the simulated camera."""
    matrix, neutral = np.reshape(color_matrix, (3, 3)), rec709_to_camera(color_matrix).sum(axis=1)
    dng_writer.write(
        path, counts, cfa=cfa, black=sensor.black, white=sensor.white, exif=exif, color_matrix=matrix,
        as_shot_neutral=neutral,
    )  # fmt: skip


def require_empty(folder: Path) -> None:
    """Raise CaptureError if the folder holds something already."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(f"{folder} is not an empty folder; choose another folder")
