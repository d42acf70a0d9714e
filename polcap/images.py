"""Values that stages pass to each other: frozen dataclasses of NumPy arrays.

Shapes: K polarizer shots, E exposures of one bracket, H×W pixels (row 0 is the top, pixel centers are whole
numbers), C = 3 channels. The one channel of a monochrome sensor is repeated in all three with three times its
variance, so that sums over channels have their true variance. Arrays may be read-only memory maps: never write into
one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any, Literal, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from polcap.calibration_values import Calibration

Floats = NDArray[np.floating[Any]]
Bits = NDArray[np.uint8]
TexturePixels = NDArray[Any]  # uint8 or uint16; a share of the type's largest value
Device = Literal["cpu", "cuda", "auto"]
Bools = NDArray[np.bool_]
Indices = NDArray[np.integer[Any]]
Faces = NDArray[np.int32]  # (F, 3) vertices of triangles
Role = Literal["shot", "ambient", "repeat", "chart", "cross"]
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


@dataclass(frozen=True)
class Exif:
    """Camera settings of one photograph from its EXIF tags; None or "" where the file has no value."""

    make: str = ""
    model: str = ""
    lens: str = ""
    exposure_time: float | None = None  # s
    f_number: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None  # mm, full-frame equivalent
    pixel_pitch_um: float | None = None  # from FocalPlaneResolution, visible RAW pixels
    taken: str = ""  # ISO 8601 with sub-seconds where known
    flash_fired: bool | None = None
    width: int | None = None  # visible RAW pixels
    height: int | None = None
    color_matrix: tuple[float, ...] | None = None  # 9, XYZ (D65 or the nearest stated illuminant) → camera

    @property
    def camera(self) -> str:
        return f"{self.make} {self.model}".strip()

    @property
    def relative_exposure(self) -> float | None:
        """Exposure by the camera settings [s · ISO/100 / f-number²]; not valid under flash."""
        if self.exposure_time is None:
            return None
        aperture = self.f_number if self.f_number else 1.0  # a lens without electronics reports 0
        return self.exposure_time * (self.iso or 100.0) / 100.0 / aperture**2


@dataclass(frozen=True, repr=False)
class SensorImage(ArrayValue):
    """One decoded frame, linear, black level not subtracted."""

    value: Floats | NDArray[np.uint16]  # (H, W) mosaic, or (H, W, 3) without a mosaic; counts
    black: Floats  # per phase of the mosaic, same shape as `cfa`; without one (1, C); or (1, 1); counts
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
class FrameReading:
    """Options for reading the pixels of a frame's file."""

    kind: Literal["raw", "photo"] = "raw"
    encoding: Literal["linear", "srgb"] | None = None  # of a developed picture; None: sRGB for 8 bits, otherwise linear
    white: float | None = None  # counts; None: from the file, or the largest value of its type
    black: float = 0.0  # counts
    cell: tuple[int, int] | None = None  # row, column to extract from the 2×2 cell of a polarization sensor's mosaic


@dataclass(frozen=True)
class Frame:
    """One photograph of a capture; a `Decode` function reads its pixels."""

    path: str = field(metadata=NOT_IN_KEY)
    exif: Exif
    role: Role
    digest: str  # of the file's bytes, then the reading options that change its pixels
    exposure: float | None = None  # relative, from capture.toml; replaces EXIF
    reading: FrameReading = field(default=FrameReading(), metadata=NOT_IN_KEY)


Decode = Callable[[Frame], SensorImage]  # as `formats.raw.frame_decoder.decode`


@dataclass(frozen=True)
class Shot:
    """All photographs of one polarizer angle: a bracket of exposures, and ambient frames."""

    angle: float  # rad, from image x towards image up
    frames: tuple[Frame, ...]  # (E,), darkest first by their metadata
    ambient: tuple[Frame, ...] = ()  # flash off, same settings
    place_px: tuple[float, float] = (0.0, 0.0)  # x, y of its pixel (0, 0) in a polarization sensor's mosaic

    @property
    def name(self) -> str:
        return f"{np.degrees(self.angle):g}°"


class CatalogEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """Facts for the catalog of a collection: the table `[catalog]` of capture.toml; an empty text is not stated."""

    title: str = ""  # of the object
    creator: str = ""  # person or institution that made the photographs
    rights: str = ""  # copyright notice
    license: str = ""  # address or name of the license
    object_number: str = ""  # inventory number of the object


@dataclass(frozen=True)
class ShotOrder:
    """A possible assignment of the stated polarizer angles to the shots: their order, and the sense of rotation."""

    shots: tuple[int, ...]  # (K,) index of the stated angle of each shot
    mirrored: bool = False  # angles count clockwise


@dataclass(frozen=True)
class AngleStatement:
    """The place where a capture states the polarizer angles of its shots, to advise how to correct them."""

    place: Literal["folders", "capture.toml", "file names", "order", "cells"] = "folders"
    texts: tuple[str, ...] = ()  # (K,) folder or file that names the angle of each shot, or the angle as stated
    cells: tuple[tuple[int, int], ...] = ()  # (K,) row, column of each shot in a polarization sensor's 2×2 cell
    clockwise: Literal["", "stated", "calibrated"] = ""  # by the user, or by the ring's calibration

    def correct(self, order: ShotOrder, angle: Floats) -> str:
        """Advice how to correct the stated angles (K,) rad to another order and sense."""
        if self.place == "cells":
            return self._cells((-1 if order.mirrored else 1) * np.degrees(angle)[list(order.shots)])
        texts = self.texts or tuple(f"{degrees:g}°" for degrees in np.degrees(angle))
        moved = [(texts[k], texts[at]) for k, at in enumerate(order.shots) if k != at]
        changes, many = " and ".join(f"{old} to {new}" for old, new in moved), "s" * (len(moved) > 1)
        how = {
            "folders": f"rename the folder{many} {changes}",
            "file names": f"rename the file{many} {changes}",
            "capture.toml": f"change the angle{many} in capture.toml: {changes}",
            "order": f"give the order --angles {','.join(texts[at] for at in order.shots)}",
        }[self.place]
        sense = {
            "": "add --clockwise, or clockwise = true in capture.toml",
            "stated": "leave out --clockwise, and clockwise in capture.toml",
            "calibrated": "repeat `polcap calibrate`: its ring counts the other way",
        }[self.clockwise]
        return ", and ".join([how] * bool(moved) + [sense] * order.mirrored)

    def turn(self, angle: Floats, turn: float) -> str:
        """Advice for stated angles (K,) rad that are too small by `turn` rad in all shots."""
        if self.place != "cells":
            return "set the ring's zero to the horizontal, or state the true angles"
        steps = round(float(turn) / (np.pi / 4))
        return self._cells(np.degrees(angle) + 45 * steps) if steps else "use the frame as the sensor delivers it"

    @property
    def retake(self) -> str:
        """Advice for one shot of another angle than stated."""
        ring = "set the ring to its mark and take the shot again, or state its true angle"
        return self.check if self.place == "cells" else ring

    @property
    def check(self) -> str:
        """Advice for angles that the pictures contradict, or do not confirm, without showing others."""
        return {
            "folders": "check the names of the folders and the ring's marks",
            "file names": "check the names of the files and the ring's marks",
            "capture.toml": "check the angles in capture.toml and the ring's marks",
            "order": "check the order of the shots (--angles) and the ring's marks",
            "cells": "check the sensor's data sheet, and state its `cells` in capture.toml",
        }[self.place]

    def _cells(self, degrees: Floats) -> str:
        """Advice to state these angles (K,) in the cells of a polarization sensor."""
        grid = {cell: round(float(one)) % 180 for cell, one in zip(self.cells, degrees)}
        left = iter({0, 45, 90, 135} - set(grid.values()))
        rows = [[grid[y, x] if (y, x) in grid else next(left) for x in (0, 1)] for y in (0, 1)]
        return f"state the angles of the sensor's cells in capture.toml: cells = {rows}"


@dataclass(frozen=True)
class Capture:
    """A capture: all photographs of one object, and the camera's geometry. The input of a run."""

    name: str = field(metadata=NOT_IN_KEY)
    folder: str = field(metadata=NOT_IN_KEY)
    shots: tuple[Shot, ...]  # (K,), the first is the reference
    layout: Literal["folders", "toml", "flat", "sensor"]
    focal_px: float  # in visible RAW pixels
    focal_known: bool
    principal_px: tuple[float, float]  # in visible RAW pixels
    size_px: tuple[int, int]  # width, height, visible RAW pixels
    chart_frames: tuple[Frame, ...] = ()
    notes: tuple[str, ...] = field(default=(), metadata=NOT_IN_KEY)  # on how the folder was read, one line each
    focal_doubt: tuple[float, float] = field(
        default=(0.0, 0.0), metadata=NOT_IN_KEY
    )  # ln of least, largest focal length / focal_px
    calibration: Calibration | None = None  # of this camera, lens and filter, if measured
    crossed: Shot | None = None  # under a polarized flash; its angle is that of the lens's polarizer
    catalog: CatalogEntry = field(default=CatalogEntry(), metadata=NOT_IN_KEY)
    angles: AngleStatement = AngleStatement()

    @property
    def all_shots(self) -> tuple[Shot, ...]:
        """The capture's shots, and the cross-polarized shot if there is one."""
        return self.shots if self.crossed is None else (*self.shots, self.crossed)

    @property
    def angle(self) -> Floats:
        """Polarizer axes (K,) rad of the shots: as stated, or corrected by the ring's calibration."""
        return self._turned(np.array([shot.angle for shot in self.shots]))

    @property
    def crossed_angle(self) -> float:
        """Polarizer axis [rad] of the cross-polarized shot; NaN without one."""
        return float("nan") if self.crossed is None else float(self._turned(np.array(self.crossed.angle)))

    def _turned(self, stated: Floats) -> Floats:
        ring = self.calibration.polarizer if self.calibration is not None else None
        return stated if ring is None else ring.sense * stated + np.radians(ring.zero_deg)


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


@dataclass(frozen=True)
class CrossedShot:
    """A shot with perpendicular polarizers at flash and lens, which block specular reflection."""

    picture: MaskedImage  # on its own grid; sensor white at its reference exposure = 1
    angle: float  # rad, of the polarizer at the lens


@dataclass(frozen=True)
class BlackError:
    """By how much the black level that the files state is too low."""

    error: Floats  # (C,) or (1,) of the sensor's range; 0: none was found
    corrected: bool = False  # the frames were read with the measured level


@dataclass(frozen=True)
class BracketMeasurement:
    """Comparison of the E frames within each of K brackets: exposure, linearity, motion, blur; NaN: unknown."""

    exposure_ratio: Floats  # (K, E, 3) of each frame to its shot's reference frame, from the pixels
    exif_ratio: Floats  # (K, E) the same from the metadata
    curvature: Floats  # (K, E) of each frame's values against those of the reference frame; 0: linear
    ghost_fraction: Floats  # (K,) share of pixels with exposures that differ by more than noise
    ambient_share: Floats  # (K,) share of the light that is present without the flash
    blur_px: Floats  # (K, E) beyond the sharpest frame of the same exposure, 1σ [RAW px]
    black: BlackError = BlackError(np.zeros(1))
    ambient_shared: bool = False  # one ambient frame was subtracted from shots of several angles


@dataclass(frozen=True)
class ColorSensor:
    """Properties of the sensor, from the files of a capture."""

    camera_matrix: Floats | None = None  # (3, 3) camera → linear Rec.709 at the white balance as shot; None: unknown
    white_balance: Floats | None = None  # (3,) multipliers as shot
    site_px: Floats | None = None  # (3, 2) x, y of each channel's photosites within a pixel of this grid; None: 0
    lossy: bool = False  # a file has 8 bits or a display encoding


@dataclass(frozen=True)
class Equipment:
    """Light, lens and polarizer of a capture, from metadata and calibration."""

    light: Literal["flash", "steady", "one exposure", "unknown"] = "unknown"  # "one exposure": polarization sensor
    flash_spread: float | None = None  # 1σ of the flash's energy, relative, calibrated
    extinction: Floats | None = None  # (3,) or (1,) extinction ratio of the polarizer, calibrated; None: ideal
    ring_sigma: float | None = None  # rad, 1σ of the ring's calibrated zero; None: not calibrated
    distortion: Distortion | None = None  # of the lens, calibrated, on this grid; None: unknown, taken as a pinhole
    angles: AngleStatement = AngleStatement()


@dataclass(frozen=True, repr=False)
class AngleStack(ArrayValue):
    """The merged shots of a capture in camera channels, before registration."""

    value: Floats  # (K, H, W, 3) sensor white at the reference exposure = 1
    variance: Floats  # (K, H, W, 3)
    quality: Bits  # (K, H, W)
    angle: Floats  # (K,) rad
    view: View
    bracket: BracketMeasurement
    sensor: ColorSensor = ColorSensor()
    equipment: Equipment = Equipment()
    offset_px: Floats | None = None  # (K, 2) x, y on this grid: shot px = reference px − offset; None: to be measured
    crossed: CrossedShot | None = None  # None: not taken
    mosaic: Mosaic | None = None  # of the first shot; None: not a binned Bayer sensor

    def shot(self, k: int) -> MaskedImage:
        """Radiance, variance and quality of shot k, (H, W, 3)."""
        return MaskedImage(self.value[k], self.variance[k], self.quality[k])


def single_frames(shots: int) -> BracketMeasurement:
    """Measurement of brackets of one frame each, which cannot be compared."""
    each, unknown = np.ones((shots, 1)), np.full((shots, 1), np.nan)
    return BracketMeasurement(np.ones((shots, 1, 3)), each, unknown, np.zeros(shots), unknown[:, 0], unknown)


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
    flash: Floats  # (3,) position right of and above the lens; exponent of the cosine of its angular falloff
    covariance: Floats  # (5, 5) of these three and of the chart's rotations about x and y [rad]
    uneven: float = 0.0  # relative 1σ of the light's level from a slope of the light that the flash does not cause

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


@dataclass(frozen=True)
class Alignment:
    """Registration of each shot to the reference shot."""

    transform: Floats  # (K, 3, 3) merged px of the reference shot → of each shot, homogeneous (x, y, 1)
    residual_px: Floats  # (K,) estimated 1σ error of the transform over the object, merged px
    correlation: Floats  # (K,) correlation of the detail after registration, zero mean; 1: equal
    crossed: Floats | None = None  # (3, 3) the same to the crossed shot; None without one


@dataclass(frozen=True, repr=False)
class ObjectMask(ArrayValue):
    """Mask of the object in the merged picture of the reference shot, the crop around it, and the mask's quality."""

    mask: Bools  # (H, W)
    crop: tuple[int, int, int, int]  # x0, y0, x1, y1 merged px, end exclusive
    source: Literal["automatic", "user"]
    doubt: float | None = None  # 1 − the expected IoU with the true mask; None without a network
    islands: float = 0.0  # share of the mask outside its largest connected part
    holes: float = 0.0  # area of the holes relative to the mask
    border: float = 0.0  # share of the picture's border that the mask covers


@dataclass(frozen=True)
class Gains:
    """Light of each shot relative to the first; each shot is divided by its gain."""

    gain: Floats  # (K, 3)
    sigma: Floats  # (K, 3) 1σ
    anchor: Floats  # (K, 3) the same from the object itself, as a cross-check
    source: Literal["grey patches", "object", "one exposure", "none"]
    disagreement: float  # largest |gain/anchor − 1| of the channel means, minus three times their common error
    grey_slope: float = float("nan")  # slope of ln light over ln reflectance of the chart's light grays; 1: linear
    chart_gloss: float = 0.0  # largest part of a shot's gain on the white patch that comes from the chart's gloss


@dataclass(frozen=True)
class OutlineCheck:
    """Comparison of the stated angles with the object's outline."""

    best: ShotOrder  # as stated, unless another order clearly fits better
    concentration: float  # 0…1, how well the AoLP follows the outline
    rival: ShotOrder | None = None  # another order that fits equally well; None: no other
    score: float = 0.0  # −1…1, as `concentration`; negative if the AoLP is along the outline

    @property
    def as_stated(self) -> bool:
        """Whether the stated order and sense of the polarizer angles fit the outline best."""
        return self.best == ShotOrder(tuple(range(len(self.best.shots))))


@dataclass(frozen=True)
class OtherOrder:
    """An order of the shots that the outline does not exclude."""

    order: ShotOrder
    matrix: Floats  # (3, 3) from the Stokes parameters by the stated order to those by this order


@dataclass(frozen=True)
class OrderTest:
    """Comparison of the stated order of the shots with other orders, by the error that the network expects."""

    rival: ShotOrder  # the other order with the least expected error
    ratio: float  # its expected error over that of the stated order


@dataclass(frozen=True)
class TurnedShot:
    """A shot whose polarizer angle contradicts the others. Only more than three shots can show this."""

    shots: tuple[int, ...] = ()  # all shots that could explain the contradiction, largest angle first; empty: all agree
    angle: float = 0.0  # rad, true minus stated angle of the first of them
    sigma: float = np.pi / 2  # rad, 1σ


@dataclass(frozen=True)
class RingZero:
    """Zero error of the polarizer's ring, common to all shots."""

    offset: float  # rad, true minus stated angle
    sigma: float  # rad, 1σ; π/2: unknown
    correction: float = 0.0  # rad, added to all angles: the offset if it is certain, otherwise 0


@dataclass(frozen=True)
class SelfCalibration:
    """Gains of the shots and corrected polarizer angles."""

    gains: Gains
    angle: Floats  # (K,) rad, of the polarizer, with the ring's correction
    outline: OutlineCheck
    ring: RingZero
    turned: TurnedShot = TurnedShot()
    found_sigma: float | None = None  # rad, 1σ of angles that were estimated; None: stated angles
    crossed: Floats | None = None  # (3,) factor from the crossed shot to the S0 of diffuse reflection; None without one
    other_orders: tuple[OtherOrder, ...] = ()  # empty: the outline confirms the stated order


@dataclass(frozen=True, repr=False)
class StokesImage(ArrayValue):
    """Linear Stokes parameters of the crop in camera channels."""

    stokes: Floats  # (3, H, W, 3) S0, S1, S2
    covariance: Floats  # (6, H, W, 3) 00 01 02 11 12 22
    quality: Bits  # (H, W)
    mask: Bools  # (H, W)
    view: View  # of the crop
    residual: Floats | None  # (H, W) |measured − fitted| / S0 where K > 3
    body: MaskedImage | None = None  # S0 of the diffuse reflection only, from a crossed shot
    detail: Floats | None = None  # (2H, 2W) float16, ln of the light of RAW pixels over these pixels, enlarged


@dataclass(frozen=True, repr=False)
class Cues(ArrayValue):
    """Inputs of the normal estimators on the crop's grid; stages/cues has each formula."""

    radiance: Floats  # (H, W, 3) S0 in linear Rec.709, chart white = its reflectance
    ratio: Floats  # (2, H, W) S1/S0 and S2/S0 over all channels
    ratio_sigma: Floats  # (H, W) 1σ of each of them
    dolp: Floats  # (H, W) debiased
    normalized_stokes: Floats  # (2, H, W) (S1, S2)/√(S1² + S2²)
    diffuse_color: Floats  # (H, W, 3) unit length, 0 where dark
    rays: Floats  # (H, W, 3) unit vectors from the surface to the camera
    mask: Bools  # (H, W)
    quality: Bits  # (H, W)
    view: View
    scale_sigma: float | None = None  # relative 1σ of the light on the chart against that on the object; None: no chart
    body: Floats | None = None  # (H, W, 3) radiance of the diffuse reflection only, from a crossed shot
    body_known: Bools | None = None  # (H, W) where the crossed shot is valid
    other_orders: tuple[OtherOrder, ...] = ()
    detail: Floats | None = None  # (2H, 2W) float16, ln of the light of RAW pixels over these pixels, enlarged


@dataclass(frozen=True)
class Network:
    """A model file and its metadata; a `RunNetwork` function runs it."""

    digest: str
    channels: tuple[str, ...]  # names of stages/cues, in order
    metadata: Mapping[str, str]
    fine: "Network | None" = None  # refinement network, adds fine relief to the normals
    path: str = field(default="", metadata=NOT_IN_KEY)
    device: Device = field(default="cpu", metadata=NOT_IN_KEY)
    threads: int = field(default=0, metadata=NOT_IN_KEY)  # 0: all that polcap may use
    at_once: int = field(default=1, compare=False, metadata=NOT_IN_KEY)  # number of runs in parallel


RunNetwork = Callable[[Network, Floats], dict[str, Floats]]  # (1, N, H, W) → name → (1, n, H, W); as `formats.onnx.run`


@dataclass(frozen=True, repr=False)
class SurfaceMaps(ArrayValue):
    """Appearance and shape of the object on the crop's grid, camera frame."""

    normal: Floats  # (H, W, 3) unit, x right, y up, z to the camera
    diffuse: Floats  # (H, W, 3) albedo ρ_d, linear Rec.709
    specular: Floats  # (H, W, 3) F0, linear Rec.709
    roughness: Floats  # (H, W) perceptual, α = roughness²
    depth_prior: Floats | None  # (H, W) coarse depth, growing away, mean about 0; unit: √(mask pixels/π) px
    confidence: Floats  # (H, W) expected normal error, degrees
    mask: Bools  # (H, W)
    view: View
    estimator: str
    albedo_sigma: float | None = None  # relative 1σ of the scale of all albedos; None: unknown, albedos are relative
    detail: Floats | None = None  # (2H, 2W) float16, ln of the albedo of RAW pixels over `diffuse`, enlarged
    order: OrderTest | None = None  # None without a network, or without other orders


class TextureMaps(Protocol):
    """Appearance of a surface on a pixel grid, as an asset's textures need it: `SurfaceMaps` or an atlas."""

    @property
    def normal(self) -> Floats: ...  # (H, W, 3) unit, in the mesh's frame
    @property
    def diffuse(self) -> Floats: ...  # (H, W, 3) albedo ρ_d, linear Rec.709
    @property
    def specular(self) -> Floats: ...  # (H, W, 3) F0, linear Rec.709
    @property
    def roughness(self) -> Floats: ...  # (H, W) perceptual, α = roughness²
    @property
    def mask(self) -> Bools: ...  # (H, W)
    @property
    def albedo_sigma(self) -> float | None: ...  # relative 1σ of the scale of all albedos; None: unknown
    @property
    def detail(self) -> Floats | None: ...  # (2H, 2W) float16, ln of the albedo of RAW pixels over `diffuse`


@dataclass(frozen=True, repr=False)
class Mesh(ArrayValue):
    """A triangle mesh with texture coordinates, as exporters need it, and figures on its boundary."""

    vertices: Floats  # (V, 3) in `frame`; metres where `metric`
    normals: Floats  # (V, 3) unit
    uv: Floats  # (V, 2) 0…1, v down (glTF)
    tangents: Floats  # (V, 4) unit, w = handedness
    faces: Faces  # (F, 3) counter-clockwise seen from outside
    metric: bool
    pieces: int = 1  # number of separate parts, without specks
    cuts: float = 0.0  # length of the boundary inside the mask, both sides, over the length along the mask's outline
    cut_px: float = 0.0  # length of the cuts inside the mask, one side, px of the maps
    raggedness: float = 0.0  # length of the boundary over its smoothed length, minus 1; before smoothing
    frame: Literal["camera", "board"] = "camera"


@dataclass(frozen=True, repr=False, kw_only=True)
class ReliefMesh(Mesh):
    """The surface that one view shows, as a mesh over its depth map; unless metric, its depth is 1 focal length."""

    depth: Floats  # (H, W) along the optical axis, growing away from the camera; NaN outside


@dataclass(frozen=True, repr=False)
class Asset(ArrayValue):
    """A 3-D asset: mesh with glTF textures and material factors."""

    mesh: Mesh
    base_color: TexturePixels  # (H, W, 3) sRGB; (2H, 2W, 3) with the detail of RAW pixels
    occlusion_roughness_metallic: TexturePixels  # (H, W, 3) linear
    normal: TexturePixels  # (H, W, 3) tangent space, +Y
    specular_color: TexturePixels  # (H, W, 3) sRGB, to be multiplied by the factor
    specular_factor: tuple[float, float, float]  # KHR_materials_specular specularColorFactor
    ior: float
    displacement: TexturePixels | None = None  # (H, W) 0 at the farthest point, 1 at the nearest
    object_normal: TexturePixels | None = None  # (H, W, 3) camera frame, n * 0.5 + 0.5
    albedo_sigma: float | None = None  # as in `SurfaceMaps`

    @property
    def has_occlusion(self) -> bool:
        """Whether ambient occlusion darkens any texel; else its channel is 1."""
        return bool(np.ptp(self.occlusion_roughness_metallic[..., 0]))


@dataclass(frozen=True, repr=False)
class GBuffer(ArrayValue):
    """Geometry buffer: the surface point at each pixel."""

    normal: Floats  # (H, W, 3) unit, camera frame; 0 outside
    depth: Floats  # (H, W) along the optical axis, growing away from the camera, m; NaN outside
    mask: Bools  # (H, W)
    position: Floats  # (H, W, 3) in the object's own frame, for solid textures; 0 outside
    view: View
