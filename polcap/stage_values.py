"""Results of the stages `hdr` to `infer`, except the color calibration, and the networks that they run.

Shapes are those of `image_values.py`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from polcap.capture_values import AngleStatement, ShotOrder
from polcap.image_values import (
    NOT_IN_KEY,
    ArrayValue,
    Bits,
    Bools,
    Device,
    Distortion,
    Floats,
    MaskedImage,
    Mosaic,
    View,
)


@dataclass(frozen=True)
class CrossedShot:
    """A shot with perpendicular polarizers at flash and lens, which block specular reflection."""

    picture: MaskedImage  # on its own grid; sensor white at its reference exposure = 1
    angle: float  # rad, of the polarizer at the lens


@dataclass(frozen=True)
class BlackError:
    """Error of the black level that the files state; positive if it is too low."""

    error: Floats  # (C,) or (1,) of the sensor's range; 0: none was found
    corrected: bool = False  # the frames were read with the measured level


@dataclass(frozen=True)
class BracketMeasurement:
    """Comparison of the E frames within each of K brackets: exposure, linearity, motion, blur; NaN: unknown."""

    exposure_ratio: Floats  # (K, E, 3) of each frame to its shot's reference frame, from the pixels
    exif_ratio: Floats  # (K, E) the same from the metadata
    curvature: Floats  # (K, E) of each frame's values against those of the reference frame; 0: linear
    flicker: Floats  # (K, E) RMS change of its light from row to row, against the reference frame, relative
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
    angles: AngleStatement = AngleStatement()  # noqa: RUF009 — frozen


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
    unknown = np.full((shots, 1), np.nan)
    return BracketMeasurement(
        exposure_ratio=np.ones((shots, 1, 3)),
        exif_ratio=np.ones((shots, 1)),
        curvature=unknown,
        flicker=unknown,
        ghost_fraction=np.zeros(shots),
        ambient_share=unknown[:, 0],
        blur_px=unknown,
    )


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
    sigma: float = np.pi / 2  # rad, 1σ; π/2 without such a shot


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
    detail: Floats | None = None  # (2H, 2W) float16, ln(light at RAW pixels / enlarged light of this grid)


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
    detail: Floats | None = None  # (2H, 2W) float16, ln(light at RAW pixels / enlarged light of this grid)


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
    confidence: Floats  # (H, W) expected normal error, degrees, not a confidence: the name is a key of stored maps
    mask: Bools  # (H, W)
    view: View
    estimator: str
    albedo_sigma: float | None = None  # relative 1σ of the scale of all albedos; None: unknown, albedos are relative
    detail: Floats | None = None  # (2H, 2W) float16, ln(albedo at RAW pixels / enlarged `diffuse`)
    order: OrderTest | None = None  # None without a network, or if the outline excludes all other orders
    diffuse_error: Floats | None = None  # (H, W) 1σ of the mean of its channels; the gates set it
    roughness_error: Floats | None = None  # (H, W) 1σ of `roughness`; without a network the gates set it
