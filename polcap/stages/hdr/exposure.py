"""Exposure of a frame relative to another: measured in their pixels, or stated by the metadata."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.errors import CaptureError
from polcap.images import Floats, Frame
from polcap.optics.robust import MAD_TO_SIGMA
from polcap.stages.hdr.planes import Signals, tile_means

_TONE_RANGE, _TONE_BINS, _TONE_SPAN = (0.01, 0.9), 8, 0.7  # of the sensor's range; bins; ln of brightness, one stop
TILE = 16  # px
_LEAST_TILES = 30
_SURE, _LEAST_SURE = 0.01, 0.03  # relative 1σ of a channel's ratio, of that of all channels
_DIM, _DIMMEST = 4e-3, 4e-4  # of the sensor's range: tiles below are left to black-level errors


@dataclass(frozen=True)
class Ratio:
    """Exposure of one frame over that of another."""

    value: Floats  # (C,)
    sigma: Floats  # (C,) 1σ, relative


def ratio(reference: Signals, other: Signals) -> Ratio | None:
    """other / reference (C,) of registered signals; None where their pixels cannot tell."""
    return of_tiles(*common_tiles(reference, other))


def of_tiles(a: Floats, b: Floats) -> Ratio | None:
    """The same of tiles (T, C) of both, see `common_tiles`.

    The quotient of sums over tiles: of Poisson counts the maximum-likelihood estimate, and free of the bias of a mean
    of quotients or of logarithms. Tiles that disagree (something moved) are dropped. A channel too dim to be known to
    1 % takes the ratio of all channels together.
    """
    if not len(a):
        return None
    found = [_quotient(a[:, c], b[:, c]) for c in range(a.shape[1])]
    sums = _quotient(a.sum(axis=1), b.sum(axis=1))
    if sums is None or sums[1] > _LEAST_SURE:
        return None
    value, sigma = np.array([one if one is not None and one[1] < _SURE else sums for one in found]).T
    return Ratio(value, sigma)


def common_tiles(reference: Signals, other: Signals) -> tuple[Floats, Floats]:
    """Means (T, C) of the tiles that are usable throughout in both."""
    channels, height, width = reference.shape
    usable = (reference.usable & other.usable).view(np.uint8) * np.uint8(255)
    tiled = usable[: height // TILE * TILE, : width // TILE * TILE]
    if not tiled.size:
        return np.zeros((0, channels)), np.zeros((0, channels))
    # one unusable pixel of the 256 takes the mean to 254
    inside = cv2.resize(tiled, (width // TILE, height // TILE), interpolation=cv2.INTER_AREA) == 255
    a, b = (tile_means(picture, TILE)[inside].astype(np.float64) for picture in (reference, other))
    return a, b


def measured_or_stated(name: str, measured: Ratio | None, channels: int, frame: Frame, reference: Frame) -> Floats:
    """Exposure relative to the reference frame, (C,) float32.

    Raises CaptureError, with the frame's name, where neither pixels nor metadata tell it.
    """
    if measured is not None:
        return measured.value.astype(np.float32)
    by_metadata = stated(frame, reference)
    by_hand = frame.exposure is not None and reference.exposure is not None
    if not np.isfinite(by_metadata) or (frame.exif.flash_fired and not by_hand):
        why = "it states no exposure"
        if np.isfinite(by_metadata):
            why = "the flash fired, so its shutter time does not set the exposure"
        raise CaptureError(
            f"{name} shares too few well exposed pixels with the reference frame to measure its exposure, "
            f"and {why}: state `exposure` in capture.toml, or leave the frame out"
        )
    return np.full(channels, by_metadata, np.float32)


def stated(frame: Frame, reference: Frame) -> float:
    """Exposure relative to the reference frame as stated, or by the camera's settings; NaN if unknown."""
    if frame.exposure and reference.exposure:
        return frame.exposure / reference.exposure
    return _by_settings(frame, reference)


def of_ambient(frame: Frame, reference: Frame) -> float:
    """Ambient light that a frame gathers, relative to the reference frame; 1 where the metadata do not tell."""
    settings = _by_settings(frame, reference)
    return settings if np.isfinite(settings) else 1.0


def _by_settings(frame: Frame, reference: Frame) -> float:
    a, b = frame.exif.relative_exposure, reference.exif.relative_exposure
    return a / b if a and b else float("nan")


def curvature(a: Floats, b: Floats) -> float:
    """How the exposure ratio of two frames changes with brightness: d ln(other/reference) / d ln(both); 0: linear.

    A tone curve, unlike a lamp, changes the ratio from shadows to highlights. NaN where the frames span too little.
    a, b (T, C): of `common_tiles`.
    """
    a, b = a.mean(axis=1), b.mean(axis=1)
    lit = (a > _TONE_RANGE[0]) & (b > _TONE_RANGE[0]) & (a < _TONE_RANGE[1]) & (b < _TONE_RANGE[1])
    if lit.sum() < 4 * _LEAST_TILES:
        return float("nan")
    level, change = (np.log(a[lit]) + np.log(b[lit])) / 2, np.log(b[lit] / a[lit])
    edges = np.quantile(level, np.linspace(0, 1, _TONE_BINS + 1))
    which = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, _TONE_BINS - 1)
    bins = [which == n for n in range(_TONE_BINS) if (which == n).any()]
    x, y = (np.array([np.median(values[one]) for one in bins]) for values in (level, change))
    if np.ptp(x) < _TONE_SPAN:
        return float("nan")
    return float(np.polyfit(x, y, 1)[0])


def _quotient(a: Floats, b: Floats) -> tuple[float, float] | None:
    """Σb / Σa over the tiles that agree, and its relative 1σ."""
    for dim in (_DIM, _DIMMEST):
        bright = (a > dim) & (b > dim)
        if bright.sum() >= _LEAST_TILES:
            break
    else:
        return None
    a, b = a[bright], b[bright]
    order = np.argsort(b / a)
    weight = np.cumsum(a[order])
    r = float((b / a)[order][np.searchsorted(weight, weight[-1] / 2)])  # weighted median
    keep = np.ones(len(a), bool)
    for _ in range(6):
        error = (b - r * a) / np.sqrt(b)  # even noise, were it photons alone
        scale = MAD_TO_SIGMA * float(np.median(np.abs(error)))
        keep = np.abs(error) <= 4 * scale + 0.003 * np.sqrt(b)
        if keep.sum() < _LEAST_TILES / 2:
            return None
        r = float(b[keep].sum() / a[keep].sum())
    rest = b[keep] - r * a[keep]
    return r, float(np.sqrt(np.sum(rest**2)) / b[keep].sum())
