"""What ties the frames of one shot to its reference frame: motion, exposure ratio, noise, and where they disagree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.errors import CaptureError
from polcap.images import Floats, Frame, Shot
from polcap.optics import sensor
from polcap.stages.hdr import ambient as ambients
from polcap.stages.hdr import exposure, frame_motion, noise
from polcap.stages.hdr.ambient import promised, same_size
from polcap.stages.hdr.ghosts import Anchor, Exposed, FirstEstimate
from polcap.stages.hdr.planes import Planes, Reader, Signals

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Link:
    """What ties a frame to the reference frame of its shot, on the measuring grid."""

    ratio: Floats  # (C,) float32, exposure relative to the reference
    moved: Floats | None  # (3, 3) reference px → frame px; None: it did not move
    misfit: Floats  # (C,) float32 px²; variance per squared gradient left by registration and aliasing
    curvature: float = 0.0  # of its tone against the reference's; 0: linear, NaN: unknown


@dataclass(frozen=True)
class Registered:
    """A frame on the reference frame's grid."""

    signals: Signals
    gain: Floats | None  # (H, W) noise variance gain of resampling


@dataclass(frozen=True)
class Measured:
    """A shot, measured on the binned grid."""

    links: list[Link]
    noises: list[noise.Noise]
    ghost: Bools  # (H, W)
    estimate: Floats  # (C, H, W) the smoothed first estimate
    ambient_share: float  # of all light, there without the flash; NaN where that was not photographed
    frames: list[Registered] | None  # as they will be merged; None where ambient light was taken off


class Shooting:
    """One shot's frames as they are asked for."""

    def __init__(self, shot: Shot, reference: int, lines: noise.Lines, read: Reader, clip: float) -> None:
        self.shot, self.reference, self.lines, self.read, self.clip = shot, reference, lines, read, clip
        self.iso = [frame.exif.iso or f"frame {e}" for e, frame in enumerate(shot.frames)]
        still = read(shot.frames[reference])
        self.raw_px = still.superpixel  # of one pixel
        self.least = sensor.rounding(still) / 2  # of a binned green
        self.ambient = ambients.measure(shot, shot.frames[reference], lines, read, False, clip)

    def gathered(self, e: int) -> np.float32:
        """How much more ambient light a frame gathers than the reference frame."""
        return np.float32(ambients.gathered(self.shot.frames[e], self.shot.frames[self.reference]))

    def signals(self, e: int) -> Signals:
        """A frame's signals, less its ambient light."""
        found = self.read.signals(self.shot, e, self.clip)
        if self.ambient is None:
            return found
        if not self.lines.knows(self.iso[e]):
            self.lines.learn(self.iso[e], noise.alone(found))
        value = found.rows(slice(0, found.shape[1])) - self.gathered(e) * self.ambient.value
        return Planes(value, found.usable)

    def line(self, e: int) -> noise.Noise:
        """Noise of a frame, with that of the ambient light that was taken off it."""
        known = self.lines.line(self.iso[e], self.least)
        if self.ambient is None:
            return known
        return known.lit(self.gathered(e) * self.ambient.value.mean(axis=(1, 2)))


def measure(
    shot: Shot, order: Sequence[int], reference: int, lines: noise.Lines, read: Reader, clip: float, limit_px: float
) -> Measured:
    """Compare every frame with the reference frame.

    Parameters
    ----------
    shot
        Its frames.
    order
        Their numbers, in which they are compared.
    reference
        Number of the reference frame.
    lines
        Noise by ISO; learns that of these frames.
    read
        Decodes a frame.
    clip
        As in the stage's settings [white level].
    limit_px
        Accepted motion, visible RAW px.

    Raises
    ------
    CaptureError
        Too much motion, no common exposure, frames of unlike size.
    """
    shooting = Shooting(shot, reference, lines, read, clip)
    still = shooting.signals(reference)
    channels = still.shape[0]
    if len(order) == 1 and shooting.ambient is None:
        lines.learn(shooting.iso[reference], noise.alone(still))
    same = Link(np.ones(channels, np.float32), None, np.zeros(channels, np.float32))
    links, frames = {reference: same}, {reference: Registered(still, None)}
    ghost = np.zeros(still.usable.shape, bool)
    estimate = FirstEstimate()
    anchor: Anchor | None = None
    still_view = frame_motion.view(still) if len(order) > 1 else None
    for e in (e for e in order if e != reference):
        name = f"frame {e + 1} of shot {shot.name}"
        found = shooting.signals(e)
        same_size(name, found.shape, still.shape)
        assert still_view is not None
        moved = frame_motion.moved(name, still_view, frame_motion.view(found), limit_px / shooting.raw_px)
        unknown = shooting.ambient is None and not (
            lines.knows(shooting.iso[e]) and lines.knows(shooting.iso[reference])
        )
        blur, gain = 1.0, None
        if moved is not None:  # the scene's detail does not cancel between the frames as they are
            if unknown:
                lines.learn(shooting.iso[e], noise.alone(found))
                lines.learn(shooting.iso[reference], noise.alone(still))
            found, gain = frame_motion.resampled(found, moved)
            blur = float(gain.mean())
        tiles = exposure.common(still, found)
        ratio = _ratio(name, exposure.of_tiles(*tiles), channels, shot.frames[e], shot.frames[reference])
        if moved is None and unknown:
            for key, samples in zip((shooting.iso[reference], shooting.iso[e]), noise.paired(still, found, ratio)):
                lines.learn(key, samples)
        own, other = shooting.line(reference), shooting.line(e)
        misfit = noise.misfit(still, found, ratio, (own, other), blur)
        links[e], frames[e] = Link(ratio, moved, misfit, exposure.curvature(*tiles)), Registered(found, gain)
        frame = Exposed(found, ratio, other)
        anchor = anchor or Anchor(Exposed(still, same.ratio, own))
        new = anchor.ghosts(frame, misfit, blur)
        estimate.add(frame, found.usable & ~new)
        ghost |= new
        if e == order[0]:
            anchor.fill(frame)
    estimate.add(Exposed(still, same.ratio, shooting.line(reference)), still.usable)
    first = estimate.smoothed(still if anchor is None else anchor, ghost)
    noises = [lines.line(key, shooting.least) for key in shooting.iso]
    every = range(len(links))
    return Measured(
        links=[links[e] for e in every],
        noises=noises,
        ghost=ghost,
        estimate=first,
        ambient_share=float("nan") if shooting.ambient is None else ambients.share(shooting.ambient, first),
        frames=None if shooting.ambient is not None else [frames[e] for e in every],
    )


def stated(frame: Frame, reference: Frame) -> float:
    """Exposure relative to the reference frame as stated, or as the settings promise; NaN if unknown."""
    if frame.exposure and reference.exposure:
        return frame.exposure / reference.exposure
    return promised(frame, reference)


def _ratio(name: str, seen: exposure.Ratio | None, channels: int, frame: Frame, reference: Frame) -> Floats:
    """Exposure relative to the reference frame, (C,) float32: as seen, or else as stated."""
    if seen is not None:
        return seen.value.astype(np.float32)
    said = stated(frame, reference)
    by_hand = frame.exposure is not None and reference.exposure is not None
    if not np.isfinite(said) or (frame.exif.flash_fired and not by_hand):
        why = "the flash fired, so its shutter time says nothing" if np.isfinite(said) else "it states no exposure"
        raise CaptureError(
            f"{name} shares too few well exposed pixels with the reference frame to measure its exposure, "
            f"and {why}: state `exposure` in capture.toml, or leave the frame out"
        )
    return np.full(channels, said, np.float32)
