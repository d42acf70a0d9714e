"""Color charts: reference colors, the chart in a picture, and the color calibration made from it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from polcap.image_values import Bits, Floats


@dataclass(frozen=True)
class SurroundingPatches:
    """Patches of a large chart (ColorChecker SG) around its block of 24 patches."""

    rec709: Floats  # (M, 3) linear Rec.709/D65 reflectance
    center: Floats  # (M, 2) column and row in patches from the block's first corner, negative before it


@dataclass(frozen=True)
class ChartReference:
    """Patch colors of a color chart, from its maker or measured."""

    name: str
    rec709: Floats  # (24, 3) linear Rec.709/D65 reflectance, row by row from dark skin
    size_m: tuple[float, float] | None  # width, height between the outer patch corners; None: unknown
    patches: tuple[str, ...] = ()  # (24,) their names
    editions: tuple["ChartReference", ...] = ()  # versions of the chart from other years
    is_block: bool = False  # the 24 patches E2 to J5 of a ColorChecker SG
    surroundings: SurroundingPatches | None = None  # the other patches of that chart


@dataclass(frozen=True)
class ChartLight:
    """Pose of a chart and position of the flash; the unit of length is the chart's distance on the optical axis."""

    white: Floats  # (3,) position of the white patch, camera frame
    normal: Floats  # (3,) unit, towards the camera
    flash: Floats  # (3,) right of the lens, above the lens; last the exponent n of its angular falloff cosⁿ
    covariance: Floats  # (5, 5) of the values of `flash`, and of the chart's rotations about x and y [rad]
    uneven: float = 0.0  # relative 1σ of the light's level, because of a slope that the flash does not explain

    @property
    def tilt(self) -> float:
        """Angle between the chart's normal and the direction to the lens [rad]."""
        return float(np.arccos(np.clip(-self.normal @ self.white / np.linalg.norm(self.white), -1, 1)))


@dataclass(frozen=True)
class ChartPlace:
    """Position of a chart in the merged picture of the reference shot."""

    quads: Floats  # (24, 4, 2) corners x, y of the inner part of each patch, px
    corners: Floats  # (4, 2) outer patch corners, px


@dataclass(frozen=True)
class PatchColors:
    """Color error of each chart patch after the fit of the color matrix to the maker's colors."""

    delta_e: Floats  # (24,) CIEDE2000 residual; NaN for patches left out
    use: Bits | None = None  # (24,) `whitebalance.patches.PatchUse`: 0 used, otherwise the reason; None: unknown
    predicted: Floats | None = None  # (24,) CIEDE2000 of each patch with the matrix fitted to all others
    falloff: tuple[float, float] = (0.0, 0.0)  # relative change of the light per patch, to the right and down
    glare: float = 0.0  # white light that the chart's gloss and the lens add to every patch [reflectance]
    edition: str = ""  # `ChartReference.name` of the edition that fits best
    surroundings: Floats | None = None  # (M,) residual of the patches around the block; NaN for those left out


@dataclass(frozen=True)
class ColorCalibration:
    """Conversion of camera channels to linear Rec.709 reflectance, scaled by the chart's white patch."""

    matrix: Floats  # (3, 3) camera radiance (S0 scale: I₀ + I₉₀) → linear Rec.709 reflectance
    source: Literal["chart", "corners", "profile", "camera", "none"]
    cost: float = float("nan")  # of the chart's detector; NaN without it
    metres_per_px: float | None = None  # at the chart's distance, on this grid; None without a known chart size
    place: ChartPlace | None = None  # None without a chart in the picture
    light: ChartLight | None = None  # None without a chart under this capture's light
    patches: PatchColors | None = None  # None without a chart in this capture or in that of the color profile


@dataclass(frozen=True)
class ChartRequest:
    """The user's choice of the color calibration: search the chart, given corners, a stored profile, or none."""

    mode: Literal["auto", "corners", "profile", "none"]
    corners: Floats | None = None  # (4, 2) outer patch corners, visible RAW px, dark-skin corner first, clockwise
    profile: ColorCalibration | None = None  # from another capture with the same equipment
