"""Stage 1: merge the RAW bracket of each polarizer angle into radiance, variance and quality.

For one angle, with Y the signals of the frames and e their exposures relative to the reference frame:

1. Each frame is binned and compared with the reference frame: motion, exposure ratio per channel, sensor noise, and
   pixels that disagree (`bracket`, with `exposure`, `noise` and `ghosts`).
2. A first estimate X₀ = Σ Y/a / Σ e/a, with a the slope of the noise line, is smoothed where the picture is flat
   (`ghosts.first_estimate`). It is the maximum-likelihood merge of Poisson counts, and unbiased because no weight
   depends on a noisy pixel.
3. X = Σ w (Y/e) / Σ w with weights w = e² / (a e X₀ + b) from the smoothed estimate, without clipped pixels
   (`weights`).

References
----------
Hanji, Zhong, Mantiuk, Noise-aware merging of high dynamic range image stacks without camera calibration,
ECCV Workshops 2020. Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.capture_values import Capture, Decode, Frame, Shot, middle
from polcap.errors import CaptureError
from polcap.image_values import Distortion, Floats, MaskedImage, Quality, SensorImage, View
from polcap.optics import sharpness
from polcap.optics.projection import to_grid
from polcap.stage_values import AngleStack, BlackError, BracketMeasurement, ColorSensor, CrossedShot, Equipment
from polcap.stages import stage
from polcap.stages.hdr import exposure, noise, photosites, planes, weights
from polcap.stages.hdr.bracket import Bracket, ComparedBracket, black_error, compare
from polcap.stages.hdr.planes import Reader, check_size

_ALL_AMBIENT = 0.9  # ambient share of a shot's light; with more, nothing of the flash is left
_LEAST_PX = 48  # least side of a merged picture: noise and motion are measured in tiles


class HdrSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `hdr`, the section `hdr` of a settings file: how brackets are merged."""

    clip: Annotated[
        float,
        Meta(
            ge=0.5,
            le=1.0,
            description="clipping threshold: share of the count at which the sensor saturates "
            "(measured, else the stated white level) [1]",
        ),
    ] = 0.98
    demosaic: Annotated[
        Literal["superpixel", "full"],
        Meta(description="superpixel: a pixel per 2×2 quad (X-Trans 3×3); full: Bayer interpolated to the RAW's size"),
    ] = "superpixel"
    max_motion_px: Annotated[
        float, Meta(ge=0.0, le=500.0, description="a bracket that moved more is refused [visible RAW px]")
    ] = 60.0
    falloff: Annotated[bool, Meta(description="correct the lens's falloff if `polcap calibrate` has measured it")] = (
        True
    )


@dataclass(frozen=True)
class _ShotFigures:
    """Measurements of one shot of E frames."""

    ratio: list[Floats]  # E × (C,), exposure relative to the reference frame
    curvature: list[float]  # E
    flicker: list[float]  # E
    ambient_share: float
    tiles: list[sharpness.Tiles]  # E

    @classmethod
    def of(cls, compared: ComparedBracket, tiles: list[sharpness.Tiles]) -> "_ShotFigures":
        """The figures of a compared bracket, without its pixels."""
        frames = compared.frames
        return cls(
            [frame.ratio for frame in frames],
            [frame.curvature for frame in frames],
            [frame.flicker for frame in frames],
            compared.ambient_share,
            tiles,
        )


@stage(version=25)
def merge(capture: Capture, decode: Decode, settings: HdrSettings) -> AngleStack:
    """Merge every bracket: radiance (K, H, W, 3) of all shots, on the scale of each shot's reference frame.

    The reference frame is the frame of middle brightness in the first shot, and the frame of the same index in the
    other shots. So a shot has the flash energy of its reference frame. Pixels clipped in every frame are taken from the
    darkest frame and flagged CLIPPED. Pixels whose frames disagree are taken from the reference frame alone, or from
    the darkest where that clips, and flagged GHOST. Exposure ratios are measured in the pixels; those of the metadata
    are used only where pixels do not suffice and no flash fired. Ambient frames are scaled by their exposure relative
    to the shot's frames, as the camera settings state it, and subtracted; they are not registered.

    Raises CaptureError: frames of different size, unknown exposure ratios, too much motion, or ambient frames as bright
    as their shot.
    """
    frames = (frame for shot in capture.all_shots for frame in (*shot.frames, *shot.ambient))
    with closing(Reader(frames, decode, settings.clip)) as read:
        read.plan = _memory_plan(capture, read(capture.shots[0].frames[0]), settings)
        return _merge(capture, read, settings)


def _merge(capture: Capture, read: Reader, settings: HdrSettings) -> AngleStack:
    """Merge shot after shot into one stack; the first shot gives the order of brightness, black level and noise."""
    shots, count, first = capture.all_shots, len(capture.shots), capture.shots[0]  # a crossed shot is the last of all
    order = _by_brightness(first, read)
    image = _read_reference(first.frames[middle(order)], read, settings)
    sensor, view, side = _sensor(capture, image, settings), _view(capture, image, settings), image.superpixel
    full = settings.demosaic == "full" and image.cfa is not None
    bayer = image.cfa if sensor.site_px is not None and side == 2 else None  # of a binned mosaic
    stack = _empty(len(shots), *(size // side * (side if full else 1) for size in image.value.shape[:2]))
    pictures = [MaskedImage(*shot) for shot in zip(stack.value, stack.variance, stack.quality)]
    del image  # so that the reader can free the frame
    read.black = black_error(Bracket(first, order), read)
    places = sharpness.places(read(middle(first.frames)), settings.clip)  # of the frame that `polcap check` uses
    lines = noise.Lines(() if capture.calibration is None else capture.calibration.noise)
    figures: list[_ShotFigures] = []  # of each shot but the crossed one
    for k, shot in enumerate(shots):
        is_crossed = k == count  # then merged on the scale of its own middle frame: its flash has another energy
        bracket = Bracket(shot, _by_brightness(shot, read) if is_crossed else order)
        compared = compare(bracket, lines, read, settings.max_motion_px)
        weighted = weights.prepare(bracket, compared, lines, read, full)
        if k == 0:
            shape = weighted.shape
            mosaic = None if bayer is None else photosites.merge(bracket, weighted, bayer, read)
        check_size("the cross-polarized shot" if is_crossed else f"shot {shot.name}", weighted.shape, shape)
        weighted.merge_into(pictures[k])
        if not is_crossed:
            _check_ambient(compared.ambient_share, shot)
            tiles = [sharpness.take(read(frame), places, settings.clip) for frame in shot.frames]
            figures.append(_ShotFigures.of(compared, tiles))
        del weighted, compared  # memory, before the next shot
        read.forget((*shot.frames, *shot.ambient))
        lines.settle()
    if settings.falloff and capture.calibration is not None and capture.calibration.falloff is not None:
        for picture in pictures:
            weights.divide_by_falloff(picture, view, capture.size_px, capture.calibration.falloff)
    return AngleStack(
        value=stack.value[:count],
        variance=stack.variance[:count],
        quality=stack.quality[:count],
        angle=capture.angle,
        view=view,
        bracket=_measurement(capture, figures, stack.quality[:count], middle(order), read.black, side),
        sensor=replace(sensor, lossy=read.lossy),
        equipment=_equipment(capture, view),
        offset_px=_offsets(capture.shots) if capture.layout == "sensor" else None,
        crossed=None if capture.crossed is None else CrossedShot(pictures[-1], capture.crossed_angle),
        mosaic=mosaic,
    )


def _measurement(
    capture: Capture,
    figures: Sequence[_ShotFigures],
    quality: NDArray[np.uint8],
    reference: int,
    black: BlackError,
    side: int,
) -> BracketMeasurement:
    """Measurements of all shots, with their quality (K, H, W), and `side` RAW px per merged pixel."""
    ratio = np.array([shot.ratio for shot in figures], np.float64)  # (K, E, C), C 1 or 3
    return BracketMeasurement(
        exposure_ratio=np.repeat(ratio, 3 // ratio.shape[2], axis=2),
        exif_ratio=_stated_ratios(capture.shots, reference),
        curvature=np.array([shot.curvature for shot in figures], np.float64),
        flicker=np.array([shot.flicker for shot in figures], np.float64),
        ghost_fraction=np.array([np.mean((flags & Quality.GHOST) > 0) for flags in quality]),
        ambient_share=np.array([shot.ambient_share for shot in figures]),
        blur_px=sharpness.frames_blur([shot.tiles for shot in figures], side),
        black=black,
        ambient_shared=_ambient_shared(capture.shots),
    )


def _check_ambient(share: float, shot: Shot) -> None:
    """Raise CaptureError if almost all light of a shot is ambient: the flash was on for both or for none."""
    if share > _ALL_AMBIENT:
        raise CaptureError(
            f"the ambient frames of shot {shot.name} are as bright as the shot: the flash was on for both or for none; "
            "take the ambient frames again without the flash, or take them out of the folder"
        )


def _ambient_shared(shots: tuple[Shot, ...]) -> bool:
    """Whether one ambient frame belongs to shots of several angles."""
    digests = [digest for shot in shots for digest in {frame.digest for frame in shot.ambient}]
    return len(set(digests)) < len(digests)


def _stated_ratios(shots: tuple[Shot, ...], reference: int) -> Floats:
    """Exposures (K, E) of all frames by their metadata, relative to the frame of index `reference` in their shot."""
    return np.array([[exposure.stated(frame, shot.frames[reference]) for frame in shot.frames] for shot in shots])


def _memory_plan(capture: Capture, image: SensorImage, settings: HdrSettings) -> planes.MemoryPlan:
    """Memory that the merge may use, from the size of the first frame; binning leaves a quarter of the pixels."""
    height, width = image.value.shape[:2]
    pixels = height * width // (4 if image.cfa is not None and settings.demosaic == "superpixel" else 1)
    return planes.plan_memory(len(capture.shots), len(capture.shots[0].frames), pixels, image.value.nbytes)


def _by_brightness(shot: Shot, read: Reader) -> tuple[int, ...]:
    """Indices of a shot's frames, darkest first, by the brightness of their pixels."""

    def level(frame: Frame) -> float:
        image = read(frame)
        black = float(image.black.mean())
        value = image.value[: image.value.shape[0] // 2 * 2]
        rows = value[::8].mean(dtype=np.float64) + value[1::8].mean(dtype=np.float64)  # both CFA rows
        return (float(rows) / 2 - black) / (image.white - black)

    if len(shot.frames) == 1:
        return (0,)
    return tuple(int(e) for e in np.argsort([level(frame) for frame in shot.frames], kind="stable"))


def _read_reference(frame: Frame, read: Reader, settings: HdrSettings) -> SensorImage:
    """Decode the reference frame. Raises CaptureError: it cannot be demosaiced as requested, or has too few pixels."""
    image = read(frame)
    (height, width), side = image.value.shape[:2], image.superpixel
    if settings.demosaic == "full" and side == 3:
        raise CaptureError(
            f"{frame.path}: hdr.demosaic=full interpolates Bayer mosaics only, this is X-Trans; leave it at superpixel"
        )
    if min(height, width) < _LEAST_PX * side:
        raise CaptureError(
            f"{frame.path}: {width}×{height} px are too few to measure noise and movement; "
            f"polcap needs {_LEAST_PX * side} px a side"
        )
    return image


def _sensor(capture: Capture, image: SensorImage, settings: HdrSettings) -> ColorSensor:
    """Properties of the sensor, from the first shot's reference frame."""
    binned = image.cfa is not None and settings.demosaic == "superpixel" and capture.layout != "sensor"
    return ColorSensor(image.camera_matrix, image.white_balance, image.site_px if binned else None)


def _view(capture: Capture, image: SensorImage, settings: HdrSettings) -> View:
    """The pinhole camera (`View`) of the merged picture; its pixel (0, 0) is the center of a superpixel."""
    scale = 1.0 if settings.demosaic == "full" else float(image.superpixel)
    x, y = (to_grid(px, scale) for px in capture.principal_px)
    return View(capture.focal_px / scale, (x, y), scale, known=capture.focal_known)


def _empty(shots: int, height: int, width: int) -> MaskedImage:
    """Uninitialized memory (K, H, W, 3) for the merged shots."""
    value, variance = (np.empty((shots, height, width, 3), np.float32) for _ in range(2))
    return MaskedImage(value, variance, np.empty((shots, height, width), np.uint8))


def _equipment(capture: Capture, view: View) -> Equipment:
    """Light, lens distortion (in pixels of `view`) and polarizer of a capture, from metadata and calibration."""
    known = capture.calibration
    flash, ring, lens = (None, None, None) if known is None else (known.flash, known.polarizer, known.geometry)
    return Equipment(
        light=_light(capture),
        flash_spread=None if flash is None else flash.spread,
        extinction=None if ring is None else np.array(ring.extinction),
        ring_sigma=None if ring is None else np.radians(ring.zero_sigma_deg),
        distortion=None if lens is None else Distortion(view.focal, view.center, lens.k1, lens.k2),
        angles=capture.angles,
    )


def _light(capture: Capture) -> Literal["flash", "steady", "one exposure", "unknown"]:
    """Kind of light of a capture (flash, steady…), from the metadata."""
    if capture.layout == "sensor":
        return "one exposure"
    fired = {frame.exif.flash_fired for shot in capture.shots for frame in shot.frames}
    return "flash" if True in fired else "steady" if fired == {False} else "unknown"


def _offsets(shots: tuple[Shot, ...]) -> Floats:
    """Pixel offsets (K, 2) of the angles' planes of a polarization sensor, relative to the first plane."""
    return np.asarray([np.subtract(shot.place_px, shots[0].place_px) for shot in shots])
