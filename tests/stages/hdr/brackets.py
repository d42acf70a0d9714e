"""Brackets of a camera whose gain and noise are known: frames in, captures out; light in electrons."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from polcap.capture_values import Capture, Exif, Frame, Shot
from polcap.image_values import Quality, SensorImage
from polcap.stages import hdr
from polcap.stages.hdr.planes import in_memory, planar

RGGB = np.array([[0, 1], [1, 2]], np.uint8)
BLACK, WHITE, READ, GAIN = 512.0, 15871.0, 3.0, 2.0  # counts, counts, e⁻, e⁻ per count at ISO 100


@dataclass(frozen=True)
class PicturedFrame(Frame):
    """A frame with a function that makes its pixels: no file is decoded."""

    load: Callable[[], SensorImage] = field(default=None, compare=False)


def decode(frame):
    return frame.load()


def merge(captured, **settings):
    return hdr.merge(captured, decode, hdr.HdrSettings(**settings))


def ramp(height, width, low=20.0, high=1.2e5, ripple=0.2):
    """Expected electrons (h, w, 3) of the quads at exposure 1, from deep shadow to far beyond the well."""
    y, x = np.mgrid[: height // 2, : width // 2]
    level = np.exp(np.interp(x, [0, width // 2], [np.log(low), np.log(high)]))
    level = level * (1 + ripple * np.sin(x / 7) * np.sin(y / 5))
    return level[..., None] * np.array([0.6, 1.0, 0.7])


def through_filter(light):
    """The light (H, W) of each photosite of a picture (H, W, 3)."""
    colors = np.tile(RGGB, (light.shape[0] // 2, light.shape[1] // 2))[..., None].astype(int)
    return np.take_along_axis(light, colors, 2)[..., 0]


def expose(quads, exposure, rng, iso=100.0):
    """One mosaic frame of quads (h, w, 3); see `record`."""
    return record(through_filter(quads.repeat(2, 0).repeat(2, 1)) * exposure, rng, iso)


def record(light, rng, iso=100.0):
    """One frame of expected electrons (H, W): Poisson light, read noise, gain of the ISO, rounding, clipping."""
    counts = (rng.poisson(light) + rng.normal(0, READ, light.shape)) / (GAIN * 100 / iso) + BLACK
    value = np.clip(np.round(counts), 0, WHITE).astype(np.uint16)
    value.setflags(write=False)
    return SensorImage(value, np.full((2, 2), BLACK), WHITE, RGGB)


def planes(picture, usable=None):
    """A picture (H, W, C) as the merge sees it; usable (H, W), everywhere by default."""
    everywhere = np.ones(picture.shape[:2], bool)
    return in_memory(planar(picture.astype(np.float32)), everywhere if usable is None else usable, 0.98)


def frame(image, **exif):
    stated = exif.pop("exposure", None)
    return PicturedFrame("x.dng", Exif(**exif), "shot", "", stated, load=lambda: image)


def capture(*shots, ambient=()):
    return Capture(
        "test", "", tuple(Shot(np.pi / 4 * k, tuple(s), tuple(ambient)) for k, s in enumerate(shots)),
        "folders", 1000.0, True, (100.5, 80.5), (1, 1),
    )  # fmt: skip


def check_errors(stack, truth):
    """The errors of the first shot's unclipped pixels over their 1σ have mean 0 and variance 1."""
    clear = (stack.quality[0] & Quality.CLIPPED) == 0
    z = ((stack.value[0] - truth) / np.sqrt(stack.variance[0]))[clear]
    assert abs(z.mean()) < 0.05
    assert abs(z.var() - 1) < 0.1


def electrons_to_signal(electrons, iso=100.0):
    return electrons / (GAIN * 100 / iso) / (WHITE - BLACK)


BRACKETS = {
    "time": [(0.25, 100), (1, 100), (4, 100)],
    "wide": [(1 / 16, 100), (0.5, 100), (1, 100), (6, 100), (16, 100)],
    "iso": [(1, 100), (1, 400), (1, 1600)],
    "repeats": [(1, 100), (1, 100), (1, 100), (1, 100)],
    "single": [(1, 100)],
}


def bracket(quads, settings, seed=0, jitter=0.015, **exif):
    """Frames of (exposure, ISO) pairs with flash jitter, and the exposures that really were."""
    rng = np.random.default_rng(seed)
    exposures = [e * (1 + jitter * rng.normal()) for e, _ in settings]
    isos = [float(iso) for _, iso in settings]
    frames = [frame(expose(quads, e, rng, i), iso=i, flash_fired=True, **exif) for e, i in zip(exposures, isos)]
    return frames, np.array(exposures), np.array(isos)


def reference_of(stack):
    """Index of the frame whose ratio is 1 by definition."""
    return int(np.flatnonzero(np.all(stack.bracket.exposure_ratio[0] == 1, axis=1))[0])


DATA = os.environ.get("POLCAP_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="POLCAP_DATA is not set: no RAW files to merge")


def raw_file(path, **exif):
    """A DNG by rawpy alone, independent of the project's reader."""
    rawpy = pytest.importorskip("rawpy")

    def load():
        with rawpy.imread(str(path)) as raw:
            cfa = np.where(raw.raw_pattern == 3, 1, raw.raw_pattern).astype(np.uint8)
            black = np.array(raw.black_level_per_channel, float)[raw.raw_pattern]
            return SensorImage(raw.raw_image_visible.copy(), black, float(raw.white_level), cfa)

    return PicturedFrame(str(path), Exif(**exif), "shot", "", load=load)
