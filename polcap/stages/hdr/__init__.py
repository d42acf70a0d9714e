"""Stage 1: merge the RAW bracket of each polarizer angle into radiance, variance and quality.

For one angle, with the frames' exposures e relative to the reference frame (e = 1 there):

1. every frame is binned, compared with the reference frame and *measured*: motion, exposure ratio per
   channel, noise of its ISO, pixels that disagree (ghosts);
2. a first estimate X₀ = Σ Y/a / Σ e/a (a = noise slope; the Poisson maximum-likelihood merge, unbiased
   because no weight depends on a noisy pixel) is smoothed where it is flat;
3. X = Σ w (Y/e) / Σ w with w = e² / (a e X₀ + b) from that smoothed estimate, clipped pixels left out.

Frames stream: at most three RAW frames are held at a time, and work goes on in blocks of rows.

References
----------
Hanji, Zhong, Mantiuk, Noise-aware merging of high dynamic range image stacks without camera calibration,
ECCV Workshops 2020. Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010.
"""

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.errors import CaptureError
from polcap.images import AngleStack, Bits, Capture, Floats, Frame, Quality, SensorImage, Shot, View
from polcap.optics import demosaic, sensor
from polcap.stages import stage
from polcap.stages.hdr import exposure, ghosts, motion, noise

Bools = NDArray[np.bool_]

_HELD_FRAMES, _HELD_BYTES = 3, 450_000_000
_STILL_PX = 0.05  # less motion than this is not worth a resampling


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How brackets are merged."""

    clip: Annotated[float, Meta(ge=0.5, le=1.0, description="counts from here on are clipped [white level]")] = 0.98
    demosaic: Annotated[
        Literal["superpixel", "full"],
        Meta(description="one pixel per 2×2 quad (half size), or interpolated to full size"),
    ] = "superpixel"
    max_motion_px: Annotated[
        float, Meta(ge=0.0, le=500.0, description="a bracket that moved more is refused [visible RAW px]")
    ] = 60.0


@dataclass(frozen=True)
class _Link:
    """What ties a frame to the reference frame of its shot, on the measuring grid."""

    ratio: Floats  # (C,) float32, exposure relative to the reference
    moved: Floats | None  # (3, 3) reference px → frame px; None: it did not move
    misfit: Floats  # (C,) float32 px²; variance per squared gradient left by registration and aliasing


@dataclass(frozen=True)
class _Ambient:
    """Light that is there without the flash, at the settings of the reference frame."""

    value: Floats  # (H, W, C)
    variance: Floats  # (H, W, C)


@dataclass(frozen=True)
class _Merged:
    value: Floats  # (H, W, C)
    variance: Floats  # (H, W, C)
    quality: Bits  # (H, W)
    ratio: Floats  # (E, C)


@stage(version=2)
def merge(capture: Capture, settings: Settings) -> AngleStack:
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
    read = _Reader()
    order = _by_brightness(shots[0], read)
    reference = order[(len(order) - 1) // 2]
    image = read(shots[0].frames[reference])
    camera = image.camera_matrix, image.white_balance
    binned = image.cfa is not None and settings.demosaic == "superpixel"
    del image  # the reader alone decides how long a frame is held
    lines = noise.Lines()
    merged: list[_Merged] = []
    for shot in shots:
        merged.append(_merge_shot(shot, order, reference, lines, read, settings))
        _same_size(f"shot {shot.name}", merged[-1].value.shape, merged[0].value.shape)
        lines.close()
    repeat = 3 // merged[0].value.shape[2]  # one monochrome channel stands in three, of 3 × its variance
    x, y = capture.principal_px
    scale = 2.0 if binned else 1.0
    return AngleStack(
        value=_stack([m.value for m in merged], 1),
        variance=_stack([m.variance for m in merged], repeat),
        quality=np.stack([m.quality for m in merged]),
        angle=capture.angle,
        view=View(
            focal=capture.focal_px / scale,
            center=((x - 0.5) / 2, (y - 0.5) / 2) if binned else (x, y),
            scale=scale,
            known=capture.focal_known,
        ),
        exposure_ratio=np.stack([np.repeat(m.ratio, repeat, axis=1) for m in merged]),
        exif_ratio=np.array([[_told(f, shot.frames[reference]) for f in shot.frames] for shot in shots]),
        ghost_fraction=np.array([np.mean((m.quality & Quality.GHOST) > 0) for m in merged]),
        lossy=read.lossy,
        camera_matrix=camera[0],
        white_balance=camera[1],
        light=_light(capture),
        offset_px=_offsets(shots) if capture.layout == "sensor" else None,
    )


def _light(capture: Capture) -> Literal["flash", "steady", "one exposure", "unknown"]:
    """What the metadata say of the light of the shots."""
    if capture.layout == "sensor":
        return "one exposure"
    fired = {frame.exif.flash_fired for shot in capture.shots for frame in shot.frames}
    return "flash" if True in fired else "steady" if fired == {False} else "unknown"


def _offsets(shots: tuple[Shot, ...]) -> Floats:
    """Where the planes of one mosaic stand against the first, (K, 2) px."""
    return np.asarray([np.subtract(shot.place_px, shots[0].place_px) for shot in shots])


def _stack(parts: list[Floats], factor: int) -> Floats:
    """(K, H, W, 3); one channel broadcasts to three."""
    out = np.empty((len(parts), *parts[0].shape[:2], 3), np.float32)
    for k, part in enumerate(parts):
        np.multiply(part, np.float32(factor), out=out[k])
    return out


class _Reader:
    """Decoded frames, the last few kept."""

    def __init__(self) -> None:
        self.lossy = False
        self._held: OrderedDict[int, SensorImage] = OrderedDict()

    def __call__(self, frame: Frame) -> SensorImage:
        if id(frame) not in self._held:
            size = max((image.value.nbytes for image in self._held.values()), default=0)
            room = min(_HELD_FRAMES, max(1, _HELD_BYTES // size)) if size else 1
            while len(self._held) >= room:
                self._held.popitem(last=False)
            self._held[id(frame)] = frame.load()
        self._held.move_to_end(id(frame))
        image = self._held[id(frame)]
        self.lossy |= image.lossy
        return image


# ---------------------------------------------------------------- what the metadata say


def _check(shots: tuple[Shot, ...]) -> None:
    for shot in shots:
        if len(shot.frames) != len(shots[0].frames):
            raise CaptureError(
                f"shot {shot.name} has {len(shot.frames)} frames, shot {shots[0].name} has "
                f"{len(shots[0].frames)}: give every angle the same bracket"
            )


def _same_size(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if shape != expected:
        a, b = ("×".join(map(str, (s[1], s[0], s[2]))) for s in (shape, expected))
        raise CaptureError(f"{name} is {a}, the frames before it {b} [px, px, channels]: use one camera")


def _told(frame: Frame, reference: Frame) -> float:
    """Exposure relative to the reference frame as stated, or as the settings promise; NaN if unknown."""
    if frame.exposure and reference.exposure:
        return frame.exposure / reference.exposure
    return _promised(frame, reference)


def _promised(frame: Frame, reference: Frame) -> float:
    a, b = frame.exif.relative_exposure, reference.exif.relative_exposure
    return a / b if a and b else float("nan")


def _by_brightness(shot: Shot, read: _Reader) -> list[int]:
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


# ---------------------------------------------------------------- one shot


def _merge_shot(
    shot: Shot, order: list[int], reference: int, lines: noise.Lines, read: _Reader, settings: Settings
) -> _Merged:
    links, noises, ghost, estimate = _measure(shot, order, reference, lines, read, settings)
    full = settings.demosaic == "full" and read(shot.frames[reference]).cfa is not None
    if full:
        estimate, ghost = _twice(estimate), np.repeat(np.repeat(ghost, 2, axis=0), 2, axis=1)
    ambient = _ambient(shot, reference, lines, read, full)
    bright = [float(link.ratio.mean()) for link in links]
    darkest = int(np.argmin(bright))

    num, den, var = np.zeros_like(estimate), np.zeros_like(estimate), np.zeros_like(estimate)
    share = np.zeros_like(estimate if ambient is not None else estimate[:0])  # of the ambient light
    served = anchored = np.zeros(ghost.shape, bool)
    for e in [reference, *(e for e in order if e != reference)]:
        frame, link = shot.frames[e], links[e]
        image = read(frame)
        sample, usable, blur = sensor.signal(image, full), sensor.usable(image, settings.clip, full), None
        if link.moved is not None:
            sample, usable, blur = _resample(sample, usable, _on_full(link.moved) if full else link.moved)
        lit = np.float32(_lit(frame, shot.frames[reference]))
        if ambient is not None:
            sample -= lit * ambient.value
        last = bright[e] < 1.02 * bright[darkest]  # there is no darker one to fall back on
        serves = usable | last if link.moved is None else usable
        if e == reference:
            anchored = serves
        else:
            serves = serves & (~ghost | (~anchored & (e == darkest)))
        served = served | (serves & usable)
        trust = np.maximum(serves, np.float32(1e-9 if e == reference else 0))  # some value for every pixel
        for _, _, rows in ghosts.blocks(len(num), 0):
            light = estimate[rows] * link.ratio
            if ambient is not None:
                light = light + lit * np.maximum(ambient.value[rows], 0)
            v = _variance(light, noises[e], image.cfa if full else None)
            v = v if blur is None else v * blur[rows][..., None]
            v = v / link.ratio**2 + _misfit(estimate, rows, link.misfit * (4 if full else 1))
            w = trust[rows][..., None] / v
            if not last:
                w = w * _ramp(estimate[rows] * link.ratio, settings.clip)
            num[rows] += w * sample[rows] / link.ratio
            den[rows] += w
            var[rows] += w * w * v
            if ambient is not None:
                share[rows] += w * (lit / link.ratio)
        del image
    num /= den
    var /= den
    var /= den
    if ambient is not None:
        share /= den
        var += share * share * ambient.variance
    quality = np.zeros(ghost.shape, np.uint8)
    quality[~served] |= np.uint8(Quality.CLIPPED)
    quality[ghost] |= np.uint8(Quality.GHOST)
    quality[_summed(num) < 2 * np.sqrt(_summed(var))] |= np.uint8(Quality.DARK)
    return _Merged(num, var, quality, np.stack([link.ratio for link in links]).astype(np.float64))


def _variance(signal: Floats, line: noise.Noise, cfa: Bits | None) -> Floats:
    """Noise of pixels of known expected signal; cfa where they were interpolated from it, not binned."""
    expected = line.variance(signal)
    if cfa is None:
        return expected
    site = expected * np.array([1, 2, 1], np.float32)  # binned green is the mean of two photosites
    gain = demosaic.variance_gain(cfa)
    for i, j in np.ndindex(2, 2):
        site[i::2, j::2] = site[i::2, j::2] @ gain[i, j].T
    return np.asarray(site)


def _misfit(estimate: Floats, rows: slice, misfit: Floats) -> Floats:
    """Variance that registration and aliasing leave at edges, of some rows of an estimate (H, W, C)."""
    if not misfit.any():
        return np.zeros(1, np.float32)
    top = max(rows.start - 1, 0)
    edges = ghosts.edges(estimate[top : rows.stop + 1])[rows.start - top :][: rows.stop - rows.start]
    return np.asarray(edges * misfit)


def _ramp(predicted: Floats, clip: float) -> Floats:
    """1 well below saturation, falling to 0 at it, so that no frame drops out in a step; (h, w, 1)."""
    peak = np.maximum.reduce([predicted[..., c : c + 1] for c in range(predicted.shape[2])])
    return np.asarray(np.clip((clip - peak) / 0.05, 1e-3, 1))


def _summed(picture: Floats) -> Floats:
    """Over channels, (H, W); much faster than numpy's sum over a short last axis."""
    return np.asarray(picture @ np.ones(picture.shape[2], picture.dtype))


def _twice(picture: Floats) -> Floats:
    """A binned picture on the full grid; cv2 keeps the half-pixel offset of the two."""
    h, w, channels = picture.shape
    return np.asarray(cv2.resize(picture, (2 * w, 2 * h))).reshape(2 * h, 2 * w, channels)


# ---------------------------------------------------------------- measuring


def _measure(
    shot: Shot, order: list[int], reference: int, lines: noise.Lines, read: _Reader, settings: Settings
) -> tuple[list[_Link], list[noise.Noise], Bools, Floats]:
    """Links and noise of all frames, ghosts (h, w) and the smoothed first estimate (h, w, C), all binned."""
    iso = [frame.exif.iso or f"frame {e}" for e, frame in enumerate(shot.frames)]
    raw_px = 1.0 if read(shot.frames[reference]).cfa is None else 2.0  # of one pixel
    least = sensor.rounding(read(shot.frames[reference])) / 2  # of a binned green
    ambient = _ambient(shot, reference, lines, read, False)

    room = [np.float32(_lit(frame, shot.frames[reference])) for frame in shot.frames]

    def expose(e: int) -> tuple[Floats, Bools]:
        image = read(shot.frames[e])
        value, usable = sensor.signal(image), sensor.usable(image, settings.clip)
        if ambient is not None:
            if not lines.knows(iso[e]):
                lines.learn(iso[e], noise.alone(value, usable))
            value -= room[e] * ambient.value
        return value, usable

    def line(e: int) -> noise.Noise:
        known = lines.line(iso[e], least)
        return known if ambient is None else known.lit(room[e] * ambient.value.mean(axis=(0, 1)))

    still, clear = expose(reference)
    if len(order) == 1 and ambient is None:
        lines.learn(iso[reference], noise.alone(still, clear))
    same = _Link(np.ones(still.shape[2], np.float32), None, np.zeros(still.shape[2], np.float32))
    links = {reference: same}
    ghost = np.zeros(clear.shape, bool)
    estimate = ghosts.FirstEstimate(still.shape)
    anchor: ghosts.Anchor | None = None
    for e in (e for e in order if e != reference):
        name = f"frame {e + 1} of shot {shot.name}"
        value, usable = expose(e)
        _same_size(name, value.shape, still.shape)
        moved = _moved(name, still, clear, value, usable, settings.max_motion_px / raw_px)
        news = ambient is None and not (lines.knows(iso[e]) and lines.knows(iso[reference]))
        blur = 1.0
        if moved is not None:  # the scene's detail does not cancel between the frames as they are
            if news:
                lines.learn(iso[e], noise.alone(value, usable))
                lines.learn(iso[reference], noise.alone(still, clear))
            value, usable, gain = _resample(value, usable, moved)
            blur = float(gain.mean())
        both = clear & usable
        ratio = _ratio(name, still, value, both, shot.frames[e], shot.frames[reference])
        if moved is None and news:
            for key, samples in zip((iso[reference], iso[e]), noise.paired(still, value, ratio, both)):
                lines.learn(key, samples)
        own, other = line(reference), line(e)
        misfit = noise.misfit(still, value, ratio, (own, other), blur, both)
        links[e] = _Link(ratio, moved, misfit)
        anchor = anchor or ghosts.Anchor(still, clear, own)
        new = anchor.ghosts(value, usable, ratio, other, misfit, blur)
        estimate.add(value, usable & ~new, ratio, other)
        ghost |= new
        if e == order[0]:
            anchor.fill(value, usable, ratio, other)
    estimate.add(still, clear, same.ratio, line(reference))
    first = estimate.smoothed(still if anchor is None else anchor.value, ghost)
    noises = [lines.line(key, least) for key in iso]
    return [links[e] for e in range(len(iso))], noises, ghost, first


def _moved(name: str, still: Floats, clear: Bools, value: Floats, usable: Bools, limit: float) -> Floats | None:
    """Reference px → frame px, or None where the frame did not move measurably."""

    def prepared(picture: Floats) -> Floats:
        smooth = cv2.GaussianBlur(_summed(picture), (0, 0), 0.8)
        return np.asarray(np.sqrt(np.maximum(smooth, 0) + np.float32(1e-4)))

    found = motion.estimate(prepared(still), prepared(value), clear, usable)
    if found.shift_px > limit:
        raise CaptureError(
            f"{name} moved by {found.shift_px:.0f} px against the bracket's reference frame, more than "
            f"{limit:.0f}: use a tripod, or raise hdr.max_motion_px"
        )
    return found.matrix if found.shift_px > max(_STILL_PX, 3 * found.sigma_px) else None


def _ratio(name: str, still: Floats, value: Floats, both: Bools, frame: Frame, reference: Frame) -> Floats:
    """Exposure relative to the reference frame, (C,) float32."""
    found = exposure.ratio(still, value, both)
    if found is not None:
        return found.value.astype(np.float32)
    told = _told(frame, reference)
    stated = frame.exposure is not None and reference.exposure is not None
    if not np.isfinite(told) or (frame.exif.flash_fired and not stated):
        why = "the flash fired, so its shutter time says nothing" if np.isfinite(told) else "it states no exposure"
        raise CaptureError(
            f"{name} shares too few well exposed pixels with the reference frame to measure its exposure, "
            f"and {why}: state `exposure` in capture.toml, or leave the frame out"
        )
    return np.full(still.shape[2], told, np.float32)


# ---------------------------------------------------------------- ambient light and resampling


def _lit(frame: Frame, reference: Frame) -> float:
    """How much more ambient light a frame gathers than the reference frame; 1 if the metadata are silent."""
    promised = _promised(frame, reference)
    return promised if np.isfinite(promised) else 1.0


def _ambient(shot: Shot, reference: int, lines: noise.Lines, read: _Reader, full: bool) -> _Ambient | None:
    if not shot.ambient:
        return None
    value: Floats | None = None
    lit = [_lit(frame, shot.frames[reference]) for frame in shot.ambient]
    for frame in shot.ambient:
        part = sensor.signal(read(frame), full)
        if value is not None:
            _same_size(f"an ambient frame of shot {shot.name}", part.shape, value.shape)
        value = part if value is None else value + part
    assert value is not None
    value /= np.float32(sum(lit))
    variance = np.zeros_like(value)
    for frame, share in zip(shot.ambient, lit):
        image = read(frame)
        key = frame.exif.iso or "ambient"
        if not lines.knows(key):
            lines.learn(key, noise.alone(sensor.signal(image), sensor.usable(image, 0.98)))
        line = lines.line(key, sensor.rounding(image) / 2)
        level = cv2.blur(value, (5, 5)).reshape(value.shape) * np.float32(share)
        variance += _variance(level, line, image.cfa if full else None) / np.float32(sum(lit) ** 2)
    return _Ambient(value, variance)


def _on_full(matrix: Floats) -> Floats:
    """A homography between binned grids, between the full ones."""
    full = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    return np.asarray(full @ matrix @ np.linalg.inv(full))


def _resample(sample: Floats, usable: Bools, matrix: Floats) -> tuple[Floats, Bools, Floats]:
    """A frame on the reference frame's grid (Lanczos), where it is usable, and its noise variance gain."""
    h, w = usable.shape
    inverse = cv2.WARP_INVERSE_MAP
    value = cv2.warpPerspective(
        sample, matrix, (w, h), flags=inverse | cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
    ).reshape(sample.shape)
    # no clipped pixel, nor the border, within the main lobes of the kernel
    inner = cv2.erode(usable.view(np.uint8) * 255, np.ones((5, 5), np.uint8), borderValue=0)
    seen = cv2.warpPerspective(inner, matrix, (w, h), flags=inverse | cv2.INTER_LINEAR, borderValue=0) == 255
    gain = np.empty((h, w), np.float32)
    table = _kernel_gain()
    x = np.arange(w, dtype=np.float32)
    m = matrix.astype(np.float32)
    for _, _, rows in ghosts.blocks(h, 0):
        y = np.arange(h, dtype=np.float32)[rows, None]
        depth = m[2, 0] * x + (m[2, 1] * y + m[2, 2])
        px = (m[0, 0] * x + (m[0, 1] * y + m[0, 2])) / depth
        py = (m[1, 0] * x + (m[1, 1] * y + m[1, 2])) / depth
        gain[rows] = table[((px - np.floor(px)) * 32 + 0.5).astype(np.int8)]
        gain[rows] *= table[((py - np.floor(py)) * 32 + 0.5).astype(np.int8)]
    return value, seen, gain


@lru_cache(maxsize=1)
def _kernel_gain() -> Floats:
    """Σ of squared weights of cv2's Lanczos kernel at fractions 0, 1/32 … 1 of a pixel, (33,)."""
    impulse = np.zeros((17, 33), np.float32)
    impulse[:, 16] = 1
    x = np.arange(33, dtype=np.float32)[None] + np.arange(33, dtype=np.float32)[:, None] / 32
    row = cv2.remap(impulse, x, np.full_like(x, 8), cv2.INTER_LANCZOS4)
    return np.asarray(np.sum(row.astype(np.float64) ** 2, axis=1), np.float32)
