"""Stage 1: merge the RAW bracket of each polarizer angle into radiance, variance and quality.

For one angle, with the frames' exposures e relative to the reference frame (e = 1 there):

1. every frame is binned, compared with the reference frame and *measured*: motion, exposure ratio per
   channel, noise of its ISO, pixels that disagree (ghosts);
2. a first estimate X₀ = Σ Y/a / Σ e/a (a = noise slope; the Poisson maximum-likelihood merge, unbiased
   because no weight depends on a noisy pixel) is smoothed where it is flat;
3. X = Σ w (Y/e) / Σ w with w = e² / (a e X₀ + b) from that smoothed estimate, clipped pixels left out.

Frames are decoded ahead, in processes of their own; work goes on in blocks of rows that fit a core's cache.
`planes` decodes, `links` measures a shot, `combine` weights and sums.

References
----------
Hanji, Zhong, Mantiuk, Noise-aware merging of high dynamic range image stacks without camera calibration,
ECCV Workshops 2020. Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010.
"""

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import CaptureError
from polcap.images import (
    AngleStack,
    BracketMeasurement,
    Capture,
    ColorSensor,
    CrossedShot,
    Decode,
    Distortion,
    Equipment,
    Floats,
    Frame,
    MaskedImage,
    Quality,
    SensorImage,
    Shot,
    View,
)
from polcap.optics import sharpness
from polcap.stages import stage
from polcap.stages.hdr import budget, combine, falloff, links, noise
from polcap.stages.hdr.ambient import same_size
from polcap.stages.hdr.combine import Merged
from polcap.stages.hdr.planes import Reader

_LEAST_PX = 48  # of a merged picture's side: tiles of noise, and registration at a quarter of the size


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How brackets are merged."""

    clip: Annotated[float, Meta(ge=0.5, le=1.0, description="counts from here on are clipped [white level]")] = 0.98
    demosaic: Annotated[
        Literal["superpixel", "full"],
        Meta(description="a pixel per 2×2 quad (X-Trans 3×3), or Bayer interpolated to full size"),
    ] = "superpixel"
    max_motion_px: Annotated[
        float, Meta(ge=0.0, le=500.0, description="a bracket that moved more is refused [visible RAW px]")
    ] = 60.0
    falloff: Annotated[
        bool, Meta(description="take out the lens's falloff, where `polcap calibrate` has measured it")
    ] = True


@stage(version=11)
def merge(capture: Capture, decode: Decode, settings: Settings) -> AngleStack:
    """Radiance of every shot on the scale of its reference frame.

    The reference frame is the one of middle brightness in the first shot, and of the same index in every
    shot, so that the flash energy of one pop stands for a whole shot. Clipped pixels are taken from the
    darkest frame and flagged CLIPPED where even that one clips; pixels whose frames disagree are taken
    from the reference frame alone (from the darkest where that clips) and flagged GHOST. Exposure ratios
    come from the pixels; the metadata's serve only where pixels cannot tell and no flash fired. Ambient
    frames are subtracted in proportion to the exposure their settings promise; they are not registered.

    Raises CaptureError for unequal brackets, frames of unlike size, unknown ratios and too much motion.
    """
    shots = capture.shots
    _check(shots)
    brackets = (*shots, *(() if capture.crossed is None else (capture.crossed,)))
    read = Reader((frame for shot in brackets for frame in (*shot.frames, *shot.ambient)), decode)
    try:
        return _merge(capture, read, settings)
    finally:
        read.close()


def _merge(capture: Capture, read: Reader, settings: Settings) -> AngleStack:
    shots = capture.shots
    read.budget = _budget(shots, read(shots[0].frames[0]), settings)
    order = _by_brightness(shots[0], read)
    reference = order[(len(order) - 1) // 2]
    image = read(shots[0].frames[reference])
    camera = image.camera_matrix, image.white_balance
    mosaic, full, side = image.cfa is not None, settings.demosaic == "full", image.superpixel
    site = image.site_px if mosaic and not full and capture.layout != "sensor" else None
    height, width = image.value.shape[:2]
    if full and side == 3:
        raise CaptureError(
            f"{shots[0].frames[reference].path}: hdr.demosaic=full interpolates Bayer mosaics only, this is X-Trans; "
            "leave it at superpixel"
        )
    if min(height, width) < _LEAST_PX * side:
        raise CaptureError(
            f"{shots[0].frames[reference].path}: {width}×{height} px are too few to measure noise and movement; "
            f"polcap needs {_LEAST_PX * side} px a side"
        )
    middle = (len(shots[0].frames) - 1) // 2  # by the metadata, as in `check`, which reads each frame once
    corners = sharpness.places(read(shots[0].frames[middle]), settings.clip)
    del image  # the reader alone decides how long a frame is held
    known = capture.calibration
    lines = noise.Lines(() if known is None else known.noise)
    stack = _empty(0, 0, 0)
    ratios, curvatures, ambient_shares, tiles = [], [], [], []
    shape = 0, 0, 0
    for k, shot in enumerate(shots):
        measured = links.measure(shot, order, reference, lines, read, settings.clip, settings.max_motion_px)
        mixture = combine.prepare(shot, order, reference, measured, lines, read, settings.clip, full and mosaic)
        if k == 0:
            shape = mixture.shape
            stack = _empty(len(shots), shape[1], shape[2])
        same_size(f"shot {shot.name}", mixture.shape, shape)
        mixture.into(Merged(stack.value[k], stack.variance[k], stack.quality[k]))
        ratios.append([link.ratio.astype(np.float64) for link in measured.links])
        curvatures.append([link.curvature for link in measured.links])
        ambient_shares.append(measured.ambient_share)
        tiles.append([sharpness.take(read(frame), corners, settings.clip) for frame in shot.frames])
        read.forget((*shot.frames, *shot.ambient))
        lines.close()
    crossed = None if capture.crossed is None else _crossed(capture.crossed, shape, lines, read, settings)
    scale = 1.0 if full else float(side)
    x, y = capture.principal_px
    view = View(
        focal=capture.focal_px / scale,
        center=((x - (scale - 1) / 2) / scale, (y - (scale - 1) / 2) / scale),
        scale=scale,
        known=capture.focal_known,
    )
    if known is not None and known.falloff is not None and settings.falloff:
        for value, variance in zip(stack.value, stack.variance, strict=True):
            falloff.divide(value, variance, view, capture.size_px, known.falloff)
        if crossed is not None:
            falloff.divide(crossed.value, crossed.variance, view, capture.size_px, known.falloff)
    return AngleStack(
        value=stack.value,
        variance=stack.variance,
        quality=stack.quality,
        angle=capture.angle,
        view=view,
        bracket=BracketMeasurement(
            exposure_ratio=np.repeat(np.array(ratios), 3 // shape[0], axis=2),  # a monochrome channel stands in three
            exif_ratio=np.array([[links.stated(f, shot.frames[reference]) for f in shot.frames] for shot in shots]),
            curvature=np.array(curvatures),
            ghost_fraction=np.array([np.mean((quality & Quality.GHOST) > 0) for quality in stack.quality]),
            ambient_share=np.array(ambient_shares),
            blur_px=sharpness.frames_blur(tiles, side),
        ),
        sensor=ColorSensor(*camera, site, read.lossy),
        equipment=_equipment(capture, view),
        offset_px=_offsets(shots) if capture.layout == "sensor" else None,
        crossed=None if crossed is None else CrossedShot(crossed, capture.crossed_angle),
    )


def _equipment(capture: Capture, view: View) -> Equipment:
    """Light, lens and polarizer of a capture; the lens on the grid of `view`."""
    light, known = _light(capture), capture.calibration
    if known is None:
        return Equipment(light)
    ring, lens = known.polarizer, known.geometry
    return Equipment(
        light=light,
        flash_spread=None if known.flash is None else known.flash.spread,
        extinction=None if ring is None else np.array(ring.extinction),
        ring_sigma=None if ring is None else np.radians(ring.zero_sigma_deg),
        distortion=None if lens is None else Distortion(view.focal, view.center, lens.k1, lens.k2),
    )


def _crossed(
    shot: Shot, shape: tuple[int, int, int], lines: noise.Lines, read: Reader, settings: Settings
) -> MaskedImage:
    """The crossed shot merged like the others, on the scale of its own middle frame: its flash has another power."""
    order = _by_brightness(shot, read)
    reference = order[(len(order) - 1) // 2]
    measured = links.measure(shot, order, reference, lines, read, settings.clip, settings.max_motion_px)
    full = settings.demosaic == "full" and read(shot.frames[reference]).cfa is not None
    mixture = combine.prepare(shot, order, reference, measured, lines, read, settings.clip, full)
    same_size("the cross-polarised shot", mixture.shape, shape)
    room = _empty(1, shape[1], shape[2])
    mixture.into(Merged(room.value[0], room.variance[0], room.quality[0]))
    read.forget((*shot.frames, *shot.ambient))
    lines.close()
    return MaskedImage(room.value[0], room.variance[0], room.quality[0])


def _budget(shots: tuple[Shot, ...], image: SensorImage, settings: Settings) -> budget.Budget:
    """What may be held, by the first frame's size; a binned mosaic's pixels are a quarter of its photosites."""
    height, width = image.value.shape[:2]
    binned = image.cfa is not None and settings.demosaic == "superpixel"
    pixels = height * width // (4 if binned else 1)
    return budget.plan(len(shots), len(shots[0].frames), pixels, image.value.nbytes)


def _light(capture: Capture) -> Literal["flash", "steady", "one exposure", "unknown"]:
    """What the metadata say of the light of the shots."""
    if capture.layout == "sensor":
        return "one exposure"
    fired = {frame.exif.flash_fired for shot in capture.shots for frame in shot.frames}
    return "flash" if True in fired else "steady" if fired == {False} else "unknown"


def _offsets(shots: tuple[Shot, ...]) -> Floats:
    """Where the planes of one mosaic stand against the first, (K, 2) px."""
    return np.asarray([np.subtract(shot.place_px, shots[0].place_px) for shot in shots])


def _empty(shots: int, height: int, width: int) -> Merged:
    """Room for all shots, (K, H, W, 3)."""
    value, variance = (np.empty((shots, height, width, 3), np.float32) for _ in range(2))
    return Merged(value, variance, np.empty((shots, height, width), np.uint8))


def _check(shots: tuple[Shot, ...]) -> None:
    for shot in shots:
        if len(shot.frames) != len(shots[0].frames):
            raise CaptureError(
                f"shot {shot.name} has {len(shot.frames)} frames, shot {shots[0].name} has "
                f"{len(shots[0].frames)}: give every angle the same bracket"
            )


def _by_brightness(shot: Shot, read: Reader) -> list[int]:
    """Indices of the frames, darkest first, by their pixels."""

    def level(frame: Frame) -> float:
        image = read(frame)
        black = float(image.black.mean())
        value = image.value[: image.value.shape[0] // 2 * 2]
        rows = value[::8].mean(dtype=np.float64) + value[1::8].mean(dtype=np.float64)  # of both phases
        return (float(rows) / 2 - black) / (image.white - black)

    if len(shot.frames) == 1:
        return [0]
    return [int(e) for e in np.argsort([level(frame) for frame in shot.frames], kind="stable")]
