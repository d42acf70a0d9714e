"""Compares the frames of one bracket: ambient light, motion, exposure ratio, noise, and ghosts.

Each frame is compared with the bracket's reference frame, after binning: one pixel per superpixel.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from polcap.capture_values import Shot, middle
from polcap.errors import CaptureError
from polcap.image_values import Bools, Floats
from polcap.optics import sensor
from polcap.optics.registration import Pyramid, register
from polcap.stage_values import BlackError
from polcap.stages.hdr import exposure, noise
from polcap.stages.hdr.ghosts import Anchor, RegisteredFrame, first_estimate
from polcap.stages.hdr.planes import Reader, Signals, blocks, check_size, in_memory, planar, resample

_SMOOTH = cv2.getGaussianKernel(7, 0.8, cv2.CV_32F)
# A frame that moved less than one of these is not resampled: px, and standard deviations of the measured motion.
_STILL_PX, _MOTION_SIGMAS = 0.05, 3.0
_ALWAYS_CORRECTED = 1e-3  # of the sensor's range; a smaller error of the black level is corrected, even if it is light


@dataclass(frozen=True)
class Bracket:
    """One shot of E frames, with their order by the brightness of their pixels."""

    shot: Shot
    order: tuple[int, ...]  # of the frames, darkest first

    @property
    def reference(self) -> int:
        """Index of the reference frame."""
        return middle(self.order)

    @property
    def others(self) -> list[int]:
        """Indices of all frames of the bracket except the reference frame."""
        return [e for e in self.order if e != self.reference]


@dataclass(frozen=True)
class AmbientLight:
    """Ambient light (without the flash) and its variance, for the exposure of the reference frame."""

    value: Floats  # (C, H, W)
    variance: Floats  # (C, H, W)


@dataclass(frozen=True)
class ComparedBracket:
    """Result of the comparison of a bracket's frames, on the binned grid."""

    frames: list[RegisteredFrame]  # (E,) less the ambient light, with the sensor's noise
    ghost: Bools  # (H, W)
    estimate: Floats  # (C, H, W) the smoothed first estimate
    ambient_share: float  # of all light that is not from the flash; NaN without ambient frames


def compare(bracket: Bracket, lines: noise.Lines, read: Reader, limit_px: float) -> ComparedBracket:
    """Compare every frame of a bracket with its reference frame; the noise of their ISO is added to `lines`.

    Raises CaptureError: motion of more than `limit_px` visible RAW px, unknown exposure ratios, or frames of different
    size.
    """
    source = _BracketSignals(bracket, lines, read)
    reference = source.reference_signals
    ones = np.ones(reference.shape[0], np.float32)
    if not bracket.others and source.ambient is None:
        source.learn(bracket.reference, noise.sample_frame(reference))
    ghost = np.zeros(reference.usable.shape, bool)
    frames, parts = {}, []
    anchor: Anchor | None = None  # made after the first comparison, which measures the noise
    for e in bracket.others:
        frames[e] = _compare_frame(source, e, limit_px)
        anchor = anchor or Anchor(RegisteredFrame(reference, ones, source.line(bracket.reference), 0 * ones))
        frame_ghost = anchor.ghosts(frames[e])
        parts.append((frames[e], frames[e].signals.usable & ~frame_ghost))
        ghost |= frame_ghost
        if e == bracket.order[0]:
            anchor = replace(anchor, darkest=frames[e])
    frames[bracket.reference] = RegisteredFrame(reference, ones, source.line(bracket.reference), 0 * ones)
    parts.append((frames[bracket.reference], reference.usable))
    estimate = first_estimate(parts, anchor or Anchor(frames[bracket.reference]), ghost)
    return ComparedBracket(
        frames=[replace(frames[e], noise=source.sensor_line(e)) for e in range(len(frames))],
        ghost=ghost,
        estimate=estimate,
        ambient_share=float("nan") if source.ambient is None else _ambient_share(source.ambient, estimate),
    )


def black_error(bracket: Bracket, read: Reader) -> BlackError:
    """Measure the error of the stated black level in the frames of a bracket, and decide whether to correct it.

    Light that does not scale with the exposure, such as a room's under a flash, looks the same. So an error above 0.1 %
    of the range is corrected only where the exposures follow the camera settings.
    """
    frames = bracket.shot.frames
    if bracket.shot.ambient:  # subtracting them corrects such an error for frames of their exposure
        return BlackError(np.zeros(1))
    reference, others = frames[bracket.reference], [frames[e] for e in bracket.others]
    reference_tiles, tiles = exposure.tiles(read.signals(reference)), []
    for frame in others:
        frame_tiles = exposure.tiles(read.signals(frame))
        if frame_tiles[0].shape != reference_tiles[0].shape:
            return BlackError(np.zeros(1))  # `compare` refuses the frame
        tiles.append(exposure.in_common(reference_tiles, frame_tiles))
    error, ratio = exposure.black_error(tiles)
    steady = all(exposure.scales_as_stated(one, frame, reference) for one, frame in zip(ratio.tolist(), others))
    return BlackError(error, bool(error.any()) and (steady or bool(np.abs(error).max() < _ALWAYS_CORRECTED)))


class _BracketSignals:
    """Signals and noise of a bracket's frames, with the ambient light subtracted."""

    def __init__(self, bracket: Bracket, lines: noise.Lines, read: Reader) -> None:
        self.frames, self.reference = bracket.shot.frames, bracket.reference
        self._lines, self._read = lines, read
        self.name = f"shot {bracket.shot.name}"
        self._iso = [frame.exif.iso or f"frame {e}" for e, frame in enumerate(self.frames)]
        image = read(self.frames[self.reference])
        self.raw_px = image.superpixel  # RAW px per px
        self._radiance = sensor.is_radiance(image)
        self._rounding = sensor.rounding_variance(image) / 2  # of binned green, the mean of two photosites
        self.ambient = ambient_light(bracket, lines, read)

    @cached_property
    def reference_signals(self) -> Signals:
        """Signals of the reference frame."""
        return self.signals(self.reference)

    @cached_property
    def reference_pyramid(self) -> Pyramid:
        """Brightness pyramid of the reference frame."""
        return brightness_pyramid(self.reference_signals)

    def signals(self, e: int) -> Signals:
        """Signals of frame e of the bracket, with its ambient light subtracted."""
        found = self._read.signals(self.frames[e])
        if self.ambient is None:
            return found
        if not self.settled(e):
            self.learn(e, noise.sample_frame(found))
        value = found.rows(slice(None)) - self._ambient_exposure(e) * self.ambient.value
        return in_memory(value, found.usable, found.clip)

    def line(self, e: int) -> noise.Noise:
        """Noise line of frame e, including the noise of the ambient light that was subtracted."""
        if self.ambient is None:
            return self.sensor_line(e)
        return self.sensor_line(e).with_ambient(self._ambient_exposure(e) * self.ambient.value.mean(axis=(1, 2)))

    def sensor_line(self, e: int) -> noise.Noise:
        """Noise line of frame e by the sensor alone."""
        return self._lines.line(self._iso[e], self._rounding, self._radiance)

    def settled(self, *frames: int) -> bool:
        """Whether the noise lines for the ISO of these frames are final."""
        return all(self._lines.knows(self._iso[e]) for e in frames)

    def learn(self, e: int, samples: noise.Samples) -> None:
        """Add noise samples of frame e to those of its ISO."""
        self._lines.learn(self._iso[e], samples)

    def _ambient_exposure(self, e: int) -> np.float32:
        """Exposure of frame e to ambient light, relative to the reference frame."""
        return np.float32(exposure.of_ambient(self.frames[e], self.frames[self.reference]))


def _compare_frame(source: _BracketSignals, e: int, limit_px: float) -> RegisteredFrame:
    """Measure motion, exposure ratio, noise and misfit of frame e relative to the reference frame."""
    reference = source.reference_signals
    name = f"{Path(source.frames[e].path).name}, frame {e + 1} of {source.name},"
    found, gain = source.signals(e), None
    check_size(name, found.shape, reference.shape)
    motion = measure_motion(name, source.reference_pyramid, brightness_pyramid(found), limit_px / source.raw_px)
    learn = source.ambient is None and not source.settled(e, source.reference)
    if motion is not None:  # before resampling, the scene's detail does not cancel between the frames
        if learn:
            source.learn(e, noise.sample_frame(found))
            source.learn(source.reference, noise.sample_frame(reference))
        found, gain = resample(found, motion)
    tiles = exposure.common_tiles(reference, found)
    ratio = exposure.of_frame(name, tiles, source.frames[e], source.frames[source.reference])
    if motion is None and learn:
        for number, samples in zip((source.reference, e), noise.sample_pair(reference, found, ratio)):
            source.learn(number, samples)
    frame = RegisteredFrame(
        signals=found,
        ratio=ratio,
        noise=source.line(e),
        misfit=np.zeros_like(ratio),
        motion=motion,
        gain=gain,
        vignetting=exposure.vignetting(reference, found, ratio),
        curvature=exposure.curvature(*tiles),
        flicker=exposure.flicker(reference, found),
    )
    lines = source.line(source.reference), frame.noise
    return replace(frame, misfit=noise.misfit(reference, found, ratio, lines, frame.mean_gain))


def brightness_pyramid(frame: Signals) -> Pyramid:
    """Brightness pyramid of a frame for registration: smoothed root of the channels' sum, with nearly even noise."""
    _, height, width = frame.shape
    out = np.empty((height, width), np.float32)
    for rows, inner, target in blocks(height, _SMOOTH.size // 2):
        total = sum(frame.rows(rows))
        smooth = np.asarray(cv2.sepFilter2D(total, -1, _SMOOTH, _SMOOTH))[inner]
        np.maximum(smooth, 0, out=smooth)
        smooth += np.float32(1e-4)  # limits the slope of the root
        np.sqrt(smooth, out=out[target])
    return Pyramid(out, frame.usable)


def measure_motion(name: str, reference: Pyramid, frame: Pyramid, limit_px: float) -> Floats | None:
    """Measure the motion of a frame by two pyramids: (3, 3), reference px → frame px; None: no motion.

    Raises CaptureError: the frame `name` moved by more than `limit_px` px of the pyramids.
    """
    found = register(reference, frame)
    if found.shift_px > limit_px:
        raise CaptureError(
            f"{name} moved by {found.shift_px:.0f} px against the bracket's reference frame, more than {limit_px:.0f}, "
            "or it shows another scene; check this file, take it again with a tripod, or move it out of the folder, "
            "with the same exposure of every other shot; or raise hdr.max_motion_px"
        )
    return found.matrix if found.shift_px > max(_STILL_PX, _MOTION_SIGMAS * found.sigma_px) else None


def ambient_light(bracket: Bracket, lines: noise.Lines, read: Reader, full: bool = False) -> AmbientLight | None:
    """Mean of a bracket's ambient frames (taken without flash); None if there are none.

    `full`: on the grid of the photosites instead of the superpixels.

    Raises CaptureError: the frames have different sizes.
    """
    shot, reference = bracket.shot, bracket.shot.frames[bracket.reference]
    if not shot.ambient:
        return None
    exposures = [exposure.of_ambient(frame, reference) for frame in shot.ambient]
    value = planar(sensor.signal(read(shot.ambient[0]), full))
    for frame in shot.ambient[1:]:
        signal = planar(sensor.signal(read(frame), full))
        check_size(f"an ambient frame of shot {shot.name}", signal.shape, value.shape)
        value += signal
    value /= np.float32(sum(exposures))  # (C, H, W), at the exposure of the reference frame
    variance = np.zeros_like(value)
    for frame, ratio in zip(shot.ambient, exposures):
        image = read(frame)
        iso = frame.exif.iso or "ambient"
        if not lines.knows(iso):
            lines.learn(iso, noise.sample_frame(read.signals(frame)))
        line = lines.line(iso, sensor.rounding_variance(image) / 2, sensor.is_radiance(image))
        level = np.stack([cv2.blur(plane, (5, 5)) for plane in value]) * np.float32(ratio)
        variance += noise.of_pixels(level, line, image.cfa if full else None) / np.float32(sum(exposures) ** 2)
    return AmbientLight(value, variance)


def _ambient_share(ambient: AmbientLight, flash: Floats) -> float:
    """Share of ambient light in all light, in the brighter half of the picture; `flash` (C, H, W) is flash light."""
    room, lit = (picture[:, ::4, ::4].sum(0) for picture in (ambient.value, flash))
    bright = lit + room >= np.median(lit + room)
    return float(room[bright].sum() / max(float((lit + room)[bright].sum()), 1e-9))
