"""The values that flow from room to room: frozen dataclasses of NumPy arrays.

Shapes: K polarizer shots, E exposures of one bracket, H×W pixels (row 0 on top,
pixel centres on whole numbers), C = 3 channels. A monochrome sensor's one channel
stands in all three, each with three times its variance, so that sums over channels
keep their true variance. Arrays may be read-only memory maps: never write into one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Bits = NDArray[np.uint8]
Device = Literal["cpu", "cuda", "auto"]
Bools = NDArray[np.bool_]
Role = Literal["shot", "ambient", "repeat", "chart", "cross"]
NOT_IN_KEY = {"in_key": False}  # metadata of a field that says where or how, not what: two values are one input


class Quality(IntFlag):
    """What is wrong with a pixel; bits of a uint8 map, 0 = nothing known."""

    CLIPPED = 1  # at or near sensor saturation in every exposure that could serve
    DARK = 2  # lost in its own noise: of a merged shot below 2σ, of S0 below `stokes.dark_sigma`
    OUTSIDE = 4  # not seen by every shot after registration
    ILL_POSED = 8  # DoLP above the physical maximum, or S0 ≤ 0
    METAL = 16  # channels disagree on the AoLP or DoLP as conductors' do
    GHOST = 32  # exposures of one bracket disagree beyond their noise


@dataclass(frozen=True)
class Exif:
    """The facts of one photograph's metadata that polcap uses; None where the file does not say."""

    make: str = ""
    model: str = ""
    lens: str = ""
    exposure_time: float | None = None  # s
    f_number: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None  # mm, full-frame equivalent
    pixel_pitch_um: float | None = None  # from FocalPlaneResolution, of the visible RAW pixels
    taken: str = ""  # ISO 8601 with sub-seconds where known
    flash_fired: bool | None = None
    width: int | None = None  # visible RAW pixels
    height: int | None = None
    color_matrix: tuple[float, ...] | None = None  # 9, XYZ (D65 or the nearest illuminant given) → camera

    @property
    def relative_exposure(self) -> float | None:
        """Exposure that the settings promise [s · ISO/100 / f-number²]; wrong under flash."""
        if self.exposure_time is None:
            return None
        aperture = self.f_number if self.f_number else 1.0  # an unchipped lens reports 0
        return self.exposure_time * (self.iso or 100.0) / 100.0 / aperture**2


@dataclass(frozen=True)
class SensorImage:
    """One decoded frame, linear, nothing subtracted."""

    value: Floats | NDArray[np.uint16]  # (H, W) mosaic, or (H, W, 3) where the file holds no mosaic; counts
    black: Floats  # of the mosaic's phase, as `cfa`, or (1, 1); counts
    white: float  # counts at which the sensor saturates
    cfa: Bits | None  # (2, 2), X-Trans (6, 6), of 0 R, 1 G, 2 B; None where value has three channels
    camera_matrix: Floats | None = None  # (3, 3) camera RGB → linear Rec.709 at the camera's white balance
    white_balance: Floats | None = None  # (3,) multipliers as shot, green = 1
    lossy: bool = False  # decoded from 8 bits or a display encoding

    @property
    def superpixel(self) -> int:
        """Photosites per side of the least square of all colors about its middle: 2 Bayer, 3 X-Trans, 1 no mosaic."""
        return 1 if self.cfa is None else 2 if self.cfa.shape == (2, 2) else 3

    @property
    def site_px(self) -> Floats:
        """(3, 2) x, y of each color's photosites in a superpixel, from its middle [superpixels]; 0 without a mosaic."""
        if self.cfa is None:
            return np.zeros((3, 2))
        side = self.superpixel
        square = self.cfa[:side, :side]
        return np.array([(np.argwhere(square == color).mean(axis=0)[::-1] + 0.5) / side - 0.5 for color in range(3)])


@dataclass(frozen=True)
class NoiseLine:
    """Noise of a sensor at one ISO: variance of a merged picture's pixel = slope · signal + floor, white = 1."""

    iso: float
    slope: tuple[float, ...]  # (C,)
    slope_sigma: tuple[float, ...]
    floor: tuple[float, ...]  # (C,)
    floor_sigma: tuple[float, ...]
    electrons_at_white: tuple[float, ...]  # (C,) of one photosite
    read_noise_electrons: tuple[float, ...]  # (C,) 1σ of one photosite
    read_noise_sigma: tuple[float, ...] = ()  # (C,) e⁻, 1σ of that figure, upwards
    source: str = "flat frames"  # or "bracket"


@dataclass(frozen=True)
class Levels:
    """Black and white of a sensor, counts."""

    black: tuple[float, ...]  # of the mosaic's phases, row by row
    black_sigma: tuple[float, ...]
    black_stated: tuple[float, ...]  # the maker's tags
    white_stated: float  # the maker's tags
    white: float | None = None  # where frames saturate; None where none did


@dataclass(frozen=True)
class Linearity:
    """Signal against exposure time."""

    greatest_deviation: float  # from proportional, relative
    power: float  # of the exposure time that the signal follows; 1 is linear
    power_sigma: float
    darkest: float  # of white
    brightest: float
    exposures: int


@dataclass(frozen=True)
class Falloff:
    """Light of a lens towards the corners: 1 + a r² + b r⁴ + c r⁶, r = 1 in the corners."""

    coefficient: tuple[tuple[float, float, float], ...]  # (C, 3)
    sigma: tuple[tuple[float, float, float], ...]
    corner: tuple[float, ...]  # (C,) light there
    f_number: float | None = None  # of the photographs; the falloff holds at this aperture and focal length
    focal_length_mm: float | None = None


@dataclass(frozen=True)
class LensGeometry:
    """A pinhole camera with distortion: a point at x appears at x (1 + k1 r² + k2 r⁴).

    x and r from the principal point in focal lengths.
    """

    focal_px: float  # visible RAW px
    focal_sigma_px: float
    principal_px: tuple[float, float]  # visible RAW px
    principal_sigma_px: float  # 0: assumed in the picture's middle
    k1: float
    k1_sigma: float
    k2: float
    k2_sigma: float
    size_px: tuple[int, int]  # width, height, visible RAW px
    residual_px: float  # rms of the corners, RAW px
    pinhole_residual_px: float  # the same without k1 and k2
    photographs: int
    board: str
    focal_length_mm: float | None = None  # of the photographs; the geometry holds there


@dataclass(frozen=True)
class Polarizer:
    """A filter on its ring: its axis is sense · stated + zero, from image x towards image up."""

    zero_deg: float
    zero_sigma_deg: float
    sense: int  # 1: the ring counts like the picture; −1: the other way
    sense_known: bool  # False: assumed, for light of one axis cannot tell
    extinction: tuple[float, ...]  # (C,) greatest over least transmittance
    extinction_sigma: tuple[float, ...]
    frames: int


@dataclass(frozen=True)
class FlashEnergy:
    """Energy of a flash from pop to pop, relative to its mean."""

    spread: float  # 1σ
    spread_sigma: float
    drift_per_pop: float
    drift_sigma: float
    pops: int


@dataclass(frozen=True)
class Calibration:
    """The measurements of `polcap calibrate` for one camera, lens and filter, each with its 1σ; C channels, or 1."""

    made: str  # ISO 8601
    camera: str  # make and model
    lens: str
    filter: str  # the polarizer's name, as the user gave it
    noise: tuple[NoiseLine, ...] = ()
    levels: Levels | None = None
    linearity: Linearity | None = None
    falloff: Falloff | None = None
    geometry: LensGeometry | None = None
    polarizer: Polarizer | None = None
    flash: FlashEnergy | None = None


@dataclass(frozen=True)
class FrameReading:
    """How the bytes of a frame's file become pixels."""

    kind: Literal["raw", "photo"] = "raw"
    encoding: Literal["linear", "srgb"] | None = None  # of a finished picture; None: sRGB for 8 bits, else linear
    white: float | None = None  # counts; None: the greatest of the type, or as the file states
    black: float = 0.0  # counts
    sensor_deg: float | None = None  # degrees; the angle to take out of a polarization sensor's mosaic


@dataclass(frozen=True)
class Frame:
    """One photograph of a capture; a `Decode` function reads its pixels."""

    path: str = field(metadata=NOT_IN_KEY)
    exif: Exif
    role: Role
    digest: str  # of the file's bytes; then, after spaces, the settings that decide its pixels
    exposure: float | None = None  # stated in capture.toml; relative; overrides EXIF
    reading: FrameReading = field(default=FrameReading(), metadata=NOT_IN_KEY)


Decode = Callable[[Frame], SensorImage]  # as `formats.raw.frame_decoder.decode`


@dataclass(frozen=True)
class Shot:
    """The bracket taken at one polarizer angle."""

    angle: float  # rad, from image x towards image up, as the photographer sees the picture
    frames: tuple[Frame, ...]  # (E,), darkest first as far as the metadata tells
    ambient: tuple[Frame, ...] = ()  # flash off, same settings
    place_px: tuple[float, float] = (0.0, 0.0)  # x, y of its pixel (0, 0) where shots are cut from one mosaic [its px]

    @property
    def name(self) -> str:
        return f"{np.degrees(self.angle):g}°"


@dataclass(frozen=True)
class Capture:
    """A folder of photographs as understood."""

    name: str = field(metadata=NOT_IN_KEY)
    folder: str = field(metadata=NOT_IN_KEY)
    shots: tuple[Shot, ...]  # (K,), the first is the reference
    layout: Literal["folders", "toml", "flat", "sensor"]
    focal_px: float  # in visible RAW pixels
    focal_known: bool
    principal_px: tuple[float, float]  # in visible RAW pixels
    size_px: tuple[int, int]  # width, height, visible RAW pixels
    chart_frames: tuple[Frame, ...] = ()
    notes: tuple[str, ...] = field(default=(), metadata=NOT_IN_KEY)  # what was assumed, one line each
    focal_doubt: tuple[float, float] = field(default=(0.0, 0.0), metadata=NOT_IN_KEY)  # ln of least, most over focal_px
    calibration: Calibration | None = None  # of this camera, lens and filter, where the user has measured one
    crossed: Shot | None = None  # under a polarized flash; its angle is the lens's filter, across the flash's

    @property
    def angle(self) -> Floats:
        """(K,) rad, of the polarizer's axis: as stated, or by the ring's calibration."""
        return self._turned(np.array([shot.angle for shot in self.shots]))

    @property
    def crossed_angle(self) -> float:
        """The same of the crossed shot; NaN without one."""
        return float("nan") if self.crossed is None else float(self._turned(np.array(self.crossed.angle)))

    def _turned(self, stated: Floats) -> Floats:
        ring = self.calibration.polarizer if self.calibration is not None else None
        return stated if ring is None else ring.sense * stated + np.radians(ring.zero_deg)


@dataclass(frozen=True)
class View:
    """A pinhole camera over one pixel grid."""

    focal: float  # px of this grid
    center: tuple[float, float]  # (x, y) px of this grid
    scale: float  # visible RAW pixels per pixel of this grid (2 after superpixel binning)
    origin: tuple[float, float] = (0.0, 0.0)  # full-frame grid coordinates of this grid's pixel (0, 0)
    known: bool = True  # False: the focal length is an assumption


@dataclass(frozen=True)
class Distortion:
    """What a lens does to a pinhole camera's picture on one pixel grid; see optics/distortion.py."""

    focal: float  # px of this grid
    center: tuple[float, float]  # (x, y) px of this grid, the principal point
    k1: float
    k2: float


@dataclass(frozen=True)
class MaskedImage:
    """Radiance with its doubt."""

    value: Floats  # (H, W, 3) sensor white at the reference exposure = 1; negatives kept
    variance: Floats  # (H, W, 3)
    quality: Bits  # (H, W) Quality bits


@dataclass(frozen=True)
class CrossedShot:
    """A shot under a flash polarized across the lens's filter: nothing that the surface mirrors comes through."""

    picture: MaskedImage  # on its own grid; sensor white at its reference exposure = 1
    angle: float  # rad, of the filter before the lens


@dataclass(frozen=True)
class BracketMeasurement:
    """What the frames of each bracket showed when they were compared; NaN where it is unknown."""

    exposure_ratio: Floats  # (K, E, 3) of every frame to its shot's reference frame, from pixels
    exif_ratio: Floats  # (K, E) the same by the metadata
    curvature: Floats  # (K, E) of each frame's tone against the reference's; 0: linear
    ghost_fraction: Floats  # (K,) share of pixels whose exposures disagree beyond noise
    ambient_share: Floats  # (K,) of all light, present without the flash
    blur_px: Floats  # (K, E) beyond the sharpest frame of the same exposure, 1σ [RAW px]


@dataclass(frozen=True)
class ColorSensor:
    """The sensor by the files of a capture."""

    camera_matrix: Floats | None = None  # (3, 3) camera → linear Rec.709, white balanced as shot; None if unknown
    white_balance: Floats | None = None  # (3,) multipliers as shot
    site_px: Floats | None = None  # (3, 2) x, y of this grid: where in a pixel each channel was seen; None: 0
    lossy: bool = False  # a source was 8-bit or display-encoded


@dataclass(frozen=True)
class Equipment:
    """Light, lens and polarizer of a capture, as metadata and calibration know them."""

    light: Literal["flash", "steady", "one exposure", "unknown"] = "unknown"  # of the shots; one: a polarizer mosaic
    flash_spread: float | None = None  # 1σ of the flash's energy from pop to pop, calibrated
    extinction: Floats | None = None  # (3,) or (1,) extinction ratio of the polarizer, calibrated; None: ideal
    ring_sigma: float | None = None  # rad, 1σ of the ring's zero as calibrated; None: set by eye
    distortion: Distortion | None = None  # of the lens, calibrated, on this grid; None: a pinhole, as far as is known


@dataclass(frozen=True)
class AngleStack:
    """The merged shots of a capture in camera channels, not yet registered."""

    value: Floats  # (K, H, W, 3) sensor white at the reference exposure = 1
    variance: Floats  # (K, H, W, 3)
    quality: Bits  # (K, H, W)
    angle: Floats  # (K,) rad
    view: View
    bracket: BracketMeasurement
    sensor: ColorSensor = ColorSensor()
    equipment: Equipment = Equipment()
    offset_px: Floats | None = None  # (K, 2) x, y of this grid, exactly known: reference px − offset = shot px
    crossed: CrossedShot | None = None  # where one was taken

    def shot(self, k: int) -> MaskedImage:
        """One of the shots, (H, W, 3)."""
        return MaskedImage(self.value[k], self.variance[k], self.quality[k])


def single_frames(shots: int) -> BracketMeasurement:
    """Brackets of one frame each, which leave nothing to compare."""
    each, unknown = np.ones((shots, 1)), np.full((shots, 1), np.nan)
    return BracketMeasurement(np.ones((shots, 1, 3)), each, unknown, np.zeros(shots), unknown[:, 0], unknown)


@dataclass(frozen=True)
class ChartReference:
    """The patches of a colour chart as measured by its maker."""

    name: str
    rec709: Floats  # (24, 3) linear Rec.709/D65 reflectance, row by row from dark skin
    size_m: tuple[float, float] | None  # width, height between the outer patch corners, as far as it is known
    patches: tuple[str, ...] = ()  # (24,) their names
    editions: tuple["ChartReference", ...] = ()  # the same chart as it was made at other times


@dataclass(frozen=True)
class ChartLight:
    """How a chart stands to camera and flash; lengths in distances of its middle along the optical axis."""

    white: Floats  # (3,) its white patch, camera frame
    normal: Floats  # (3,) unit, towards the camera
    flash: Floats  # (3,) right of the lens and above it; power of the cosine by which the light falls off sideways
    covariance: Floats  # (5, 5) of these three and of the chart's turn about x and y [rad]

    @property
    def tilt(self) -> float:
        """How far the chart is turned from facing the lens [rad]."""
        return float(np.arccos(np.clip(-self.normal @ self.white / np.linalg.norm(self.white), -1, 1)))


@dataclass(frozen=True)
class ChartPlace:
    """A chart in the reference shot, on its full-frame grid."""

    quads: Floats  # (24, 4, 2) inner patch quads (x, y), px
    corners: Floats  # (4, 2) outer patch corners, px


@dataclass(frozen=True)
class PatchColors:
    """The fit of a chart's patches to its maker's colors."""

    delta_e: Floats  # (24,) CIEDE2000 residual; NaN for patches left out
    use: Bits | None = None  # (24,) 0 served; else why not, `whitebalance.patches.PatchUse`; None: unknown
    predicted: Floats | None = None  # (24,) CIEDE2000 of each patch by the matrix of all others
    falloff: tuple[float, float] = (0.0, 0.0)  # relative change of the light per patch, to the chart's right, down
    glare: float = 0.0  # white light that the chart's gloss and the lens add to every patch [reflectance]
    edition: str = ""  # of the chart whose colors fit, `ChartReference.name`


@dataclass(frozen=True)
class ColorCalibration:
    """From camera channels to linear Rec.709 on the scale of the chart's white patch."""

    matrix: Floats  # (3, 3) camera radiance (S0 scale: I₀ + I₉₀) → linear Rec.709 reflectance
    source: Literal["chart", "corners", "profile", "camera", "none"]
    cost: float = float("nan")  # of the chart's detector; NaN without it
    metres_per_px: float | None = None  # at the chart's distance, on this grid; None without a known chart size
    place: ChartPlace | None = None  # None without a chart in the picture
    light: ChartLight | None = None  # the same
    patches: PatchColors | None = None  # None without a chart, here or in the capture of the profile


@dataclass(frozen=True)
class Alignment:
    """Where each shot sees what the reference shot sees."""

    transform: Floats  # (K, 3, 3) reference grid px → shot grid px, homogeneous (x, y, 1)
    residual_px: Floats  # (K,) estimated 1σ error of the transform over the object
    correlation: Floats  # (K,) zero-mean correlation of the compared detail after registration, 1 = the same
    crossed: Floats | None = None  # (3, 3) reference grid px → crossed shot's grid px; None without one


@dataclass(frozen=True)
class ObjectMask:
    """Which pixels of the full-frame grid are the object."""

    mask: NDArray[np.bool_]  # (H, W) full-frame grid
    crop: tuple[int, int, int, int]  # x0, y0, x1, y1 full-frame grid px, end exclusive
    source: Literal["automatic", "user"]
    doubt: float | None = None  # 1 − the expected IoU with the true mask; None without a network
    islands: float = 0.0  # share of the mask outside its largest part
    holes: float = 0.0  # area of its holes, over its own
    border: float = 0.0  # share of the picture's edge that it covers


@dataclass(frozen=True)
class Gains:
    """The light of each shot relative to the first; each shot is divided by its gain."""

    gain: Floats  # (K, 3)
    sigma: Floats  # (K, 3) 1σ
    anchor: Floats  # (K, 3) the same from the object itself, the cross-check
    source: Literal["grey patches", "object", "one exposure", "none"]
    disagreement: float  # largest |gain/anchor − 1| of the channel means beyond three times the error of both
    grey_slope: float = float("nan")  # of ln light over ln reflectance of the chart's light greys: 1 is linear
    chart_gloss: float = 0.0  # greatest part of a shot's ratio on the white patch that is the chart's gloss


@dataclass(frozen=True)
class ShotOrder:
    """The order and sense of the polarizer's angles."""

    shots: tuple[int, ...]  # (K,) number of the stated angle of each shot
    mirrored: bool = False  # the angles count clockwise


@dataclass(frozen=True)
class OutlineCheck:
    """The order and sense of the angles that the object's outline supports."""

    best: ShotOrder  # as stated unless another fits better beyond doubt
    concentration: float  # 0…1, how well the AoLP follows the outline
    rival: ShotOrder | None = None  # another order that fits as well; None: the outline decides

    @property
    def as_stated(self) -> bool:
        """Whether the stated order and sense fit best."""
        return self.best == ShotOrder(tuple(range(len(self.best.shots))))


@dataclass(frozen=True)
class TurnedShot:
    """The one of more than three shots that contradicts the others."""

    shots: tuple[int, ...] = ()  # the most turned first, where several would explain it; none: all agree
    angle: float = 0.0  # rad, true less stated angle of the first of them
    sigma: float = np.pi / 2  # rad, 1σ


@dataclass(frozen=True)
class RingZero:
    """The error of the polarizer ring's zero, common to all shots."""

    offset: float  # rad, true less stated angle
    sigma: float  # rad, 1σ; π/2: unknown
    correction: float = 0.0  # rad, added to all angles: the offset where it is certain


@dataclass(frozen=True)
class SelfCalibration:
    """Differences between the shots: the flash's energy and the polarizer's angles."""

    gains: Gains
    angle: Floats  # (K,) rad, of the polarizer, with the ring's correction
    outline: OutlineCheck
    ring: RingZero
    turned: TurnedShot = TurnedShot()
    found_sigma: float | None = None  # rad, 1σ of angles that were found; None: they were stated
    crossed: Floats | None = None  # (3,) S0 of a surface without gloss over the crossed shot's light; None without one


@dataclass(frozen=True)
class StokesImage:
    """Linear Stokes parameters of the crop in camera channels."""

    stokes: Floats  # (3, H, W, 3) S0, S1, S2
    covariance: Floats  # (6, H, W, 3) 00 01 02 11 12 22
    quality: Bits  # (H, W)
    mask: NDArray[np.bool_]  # (H, W)
    view: View  # of the crop
    residual: Floats | None  # (H, W) |measured − fitted| / S0 where K > 3
    body: MaskedImage | None = None  # S0 without what the surface mirrors, from a crossed shot


@dataclass(frozen=True)
class Cues:
    """What the estimators see, all on the crop's grid; see stages/cues for each formula."""

    radiance: Floats  # (H, W, 3) S0 in linear Rec.709, chart white = its reflectance
    ratio: Floats  # (2, H, W) S1/S0 and S2/S0 over all channels
    ratio_sigma: Floats  # (H, W) 1σ of each of them
    dolp: Floats  # (H, W) debiased
    normalized_stokes: Floats  # (2, H, W) (S1, S2)/√(S1² + S2²)
    diffuse_color: Floats  # (H, W, 3) unit length, 0 where dark
    rays: Floats  # (H, W, 3) unit vectors from the surface to the camera
    mask: NDArray[np.bool_]  # (H, W)
    quality: Bits  # (H, W)
    view: View
    body: Floats | None = None  # (H, W, 3) radiance without what the surface mirrors, from a crossed shot
    body_known: NDArray[np.bool_] | None = None  # (H, W) where that shot tells it


@dataclass(frozen=True)
class Network:
    """A model file and the facts of its metadata; a `RunNetwork` function runs it."""

    digest: str
    channels: tuple[str, ...]  # names of stages/cues, in order
    metadata: Mapping[str, str]
    fine: "Network | None" = None  # adds fine relief to the normals of this one
    path: str = field(default="", metadata=NOT_IN_KEY)
    device: Device = field(default="cpu", metadata=NOT_IN_KEY)
    threads: int = field(default=0, metadata=NOT_IN_KEY)  # 0: as many as polcap may use
    at_once: int = field(default=1, compare=False, metadata=NOT_IN_KEY)  # runs in parallel


RunNetwork = Callable[[Network, Floats], dict[str, Floats]]  # (1, N, H, W) → name → (1, n, H, W); as `formats.onnx.run`


@dataclass(frozen=True)
class SurfaceMaps:
    """The appearance and shape of the object on the crop's grid, camera frame."""

    normal: Floats  # (H, W, 3) unit, x right, y up, z to the camera
    diffuse: Floats  # (H, W, 3) albedo ρ_d, linear Rec.709
    specular: Floats  # (H, W, 3) F0, linear Rec.709
    roughness: Floats  # (H, W) perceptual, α = roughness²
    depth_prior: Floats | None  # (H, W) coarse depth, growing away, mean about 0; unit: √(mask pixels/π) px
    confidence: Floats  # (H, W) expected normal error, degrees
    mask: NDArray[np.bool_]  # (H, W)
    view: View
    estimator: str


@dataclass(frozen=True)
class Mesh:
    """The visible surface, as a renderer wants it."""

    vertices: Floats  # (V, 3) camera frame; metres where scaled, else the object's depth is 1 focal length
    normals: Floats  # (V, 3) unit
    uv: Floats  # (V, 2) 0…1, v down (glTF)
    tangents: Floats  # (V, 4) unit, w = handedness
    faces: NDArray[np.int32]  # (F, 3) counter-clockwise seen from the camera
    depth: Floats  # (H, W) along the optical axis, growing away from the camera; NaN outside
    metric: bool
    pieces: int  # of the seen side, without specks
    cuts: float  # length of its boundary inside the mask, both sides, over that along the mask's outline
    cut_px: float  # length of its cuts inside the mask, one side, px of the maps
    raggedness: float  # length of its boundary over that of itself smoothed, less 1; before it was smoothed


@dataclass(frozen=True)
class Asset:
    """Textures and factors in glTF's terms, with the mesh they belong to."""

    mesh: Mesh
    base_color: NDArray[np.uint8]  # (H, W, 3) sRGB
    occlusion_roughness_metallic: NDArray[np.uint8]  # (H, W, 3) linear
    normal: NDArray[np.uint8]  # (H, W, 3) tangent space, +Y
    specular_color: NDArray[np.uint8]  # (H, W, 3) sRGB, to be multiplied by the factor
    specular_factor: tuple[float, float, float]  # KHR_materials_specular specularColorFactor
    ior: float


@dataclass(frozen=True)
class ChartRequest:
    """Where the colour calibration is to come from."""

    mode: Literal["auto", "corners", "profile", "none"]
    corners: Floats | None = None  # (4, 2) outer patch corners, visible RAW px, dark-skin corner first, clockwise
    profile: ColorCalibration | None = None  # of another capture of the same set-up


@dataclass(frozen=True)
class GBuffer:
    """What a ray through each pixel meets, before any material."""

    normal: Floats  # (H, W, 3) unit, camera frame; 0 outside
    depth: Floats  # (H, W) along the optical axis, growing away from the camera, m; NaN outside
    mask: NDArray[np.bool_]  # (H, W)
    position: Floats  # (H, W, 3) in the object's own frame, for solid textures; 0 outside
    view: View
