"""Measurements of `polcap calibrate`, each value with its 1σ, and of `polcap validate`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NoiseLine:
    """Noise of a sensor at one ISO: variance = slope · signal + floor, for a pixel of the merged picture; white = 1."""

    iso: float
    slope: tuple[float, ...]  # (C,)
    slope_sigma: tuple[float, ...]
    floor: tuple[float, ...]  # (C,)
    floor_sigma: tuple[float, ...]
    electrons_at_white: tuple[float, ...]  # (C,) of one photosite
    read_noise_electrons: tuple[float, ...]  # (C,) 1σ of one photosite
    read_noise_sigma: tuple[float, ...] = ()  # (C,) e⁻, 1σ error towards larger values
    source: str = "flat frames"  # or "bracket"


@dataclass(frozen=True)
class Levels:
    """Black and white level of a sensor, in counts."""

    black: tuple[float, ...]  # per phase of the mosaic, row by row
    black_sigma: tuple[float, ...]
    black_stated: tuple[float, ...]  # from the file's metadata
    white_stated: float  # from the file's metadata
    white: float | None = None  # measured saturation; None if no frame saturated


@dataclass(frozen=True)
class Linearity:
    """Linearity of a sensor: signal against exposure time."""

    greatest_deviation: float  # from a straight line through 0, relative
    power: float  # exponent of the exposure time; 1 is linear
    power_sigma: float
    darkest: float  # signal relative to white
    brightest: float
    exposures: int


@dataclass(frozen=True)
class Falloff:
    """Light falloff of a lens: 1 + a r² + b r⁴ + c r⁶, r = 1 in the corners."""

    coefficient: tuple[tuple[float, float, float], ...]  # (C, 3)
    sigma: tuple[tuple[float, float, float], ...]
    corner: tuple[float, ...]  # (C,) light in the corners relative to the middle
    f_number: float | None = None  # of the photographs; the falloff is valid only there
    focal_length_mm: float | None = None  # likewise


@dataclass(frozen=True)
class LensGeometry:
    """Measured geometry of a lens: focal length, principal point and radial distortion, each with its 1σ.

    A point that a pinhole camera sees at x appears at x (1 + k1 r² + k2 r⁴). x and r = |x| are measured from the
    principal point, in focal lengths.
    """

    focal_px: float  # visible RAW px
    focal_sigma_px: float
    principal_px: tuple[float, float]  # visible RAW px
    principal_sigma_px: float  # 0: assumed to be the picture's middle
    k1: float
    k1_sigma: float
    k2: float
    k2_sigma: float
    size_px: tuple[int, int]  # width, height, visible RAW px
    residual_px: float  # rms of the board's corners, RAW px
    pinhole_residual_px: float  # the same without k1 and k2
    photographs: int
    board: str
    focal_length_mm: float | None = None  # of the photographs; the geometry is valid for it


@dataclass(frozen=True)
class Polarizer:
    """A polarizer on its ring: true angle = sense · stated angle + zero, from image x towards image up."""

    zero_deg: float
    zero_sigma_deg: float
    sense: int  # 1: the ring counts from image x towards image up; −1: the other way
    sense_known: bool  # False: assumed, because light of one axis does not determine it
    extinction: tuple[float, ...]  # (C,) largest over smallest transmittance
    extinction_sigma: tuple[float, ...]
    frames: int


@dataclass(frozen=True)
class FlashEnergy:
    """Variation of a flash's energy from pop to pop, relative to its mean."""

    spread: float  # 1σ
    spread_sigma: float
    drift_per_pop: float
    drift_sigma: float
    pops: int


@dataclass(frozen=True)
class Calibration:
    """Measurements of `polcap calibrate` for one camera, lens and filter, each with its 1σ; None: not measured.

    C is the number of color channels, 3 or 1.
    """

    made: str  # ISO 8601
    camera: str  # make and model
    lens: str
    filter: str  # the polarizer's name, from the user
    noise: tuple[NoiseLine, ...] = ()
    levels: Levels | None = None
    linearity: Linearity | None = None
    falloff: Falloff | None = None
    geometry: LensGeometry | None = None
    polarizer: Polarizer | None = None
    flash: FlashEnergy | None = None


@dataclass(frozen=True)
class BallAccuracy:
    """Errors of the normals of a ball, as `polcap validate` measured them with one camera, lens and filter."""

    made: str  # ISO 8601
    camera: str  # make and model
    lens: str
    filter: str  # the polarizer's name, from capture.toml
    capture: str  # name of the capture of the ball
    mean_deg: float
    median_deg: float
    expected_deg: float  # mean of the expected errors of the same pixels
    pixels: int
