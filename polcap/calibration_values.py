"""What `polcap calibrate` measures of a camera, a lens, a polarizer and a flash, as it flows to the stages.

Frozen dataclasses, each figure with its 1σ. C channels; a monochrome sensor has one.
"""

from dataclasses import dataclass


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
    """Black and white of a sensor, counts; `stated` are the maker's tags."""

    black: tuple[float, ...]  # of the mosaic's phases, row by row
    black_sigma: tuple[float, ...]
    black_stated: tuple[float, ...]
    white_stated: float
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
    f_number: float | None = None  # it holds at this aperture and focal length, where the photographs say them
    focal_length_mm: float | None = None


@dataclass(frozen=True)
class LensGeometry:
    """A pinhole camera and what its lens does to it: what belongs at x appears at x (1 + k1 r² + k2 r⁴).

    x and r from the principal point in focal lengths.
    """

    focal_px: float  # visible RAW px
    focal_sigma_px: float
    principal_px: tuple[float, float]  # visible RAW px
    principal_sigma_px: float  # 0: taken to be the picture's middle
    k1: float
    k1_sigma: float
    k2: float
    k2_sigma: float
    size_px: tuple[int, int]  # width, height, visible RAW px
    residual_px: float  # rms of the corners, RAW px
    pinhole_residual_px: float  # the same without k1 and k2
    photographs: int
    board: str
    focal_length_mm: float | None = None  # as the photographs say it; it holds there


@dataclass(frozen=True)
class Polarizer:
    """A filter on its ring: its axis stands at sense · stated + zero, from image x towards image up."""

    zero_deg: float
    zero_sigma_deg: float
    sense: int  # 1: the ring counts as the picture does; −1: the other way
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
    """What `polcap calibrate` measured of one camera, lens and filter."""

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
