"""Exposure ratio of two frames: measured in their pixels, or from metadata."""

from collections.abc import Sequence

import numpy as np

from polcap.capture_values import Frame
from polcap.errors import CaptureError
from polcap.image_values import Bools, Floats
from polcap.optics.resize import block_means
from polcap.optics.robust import MAD_TO_SIGMA, MEDIAN_SE, biweight, spread
from polcap.stages.hdr.planes import Signals, tile_means

# For `curvature`: signals that are used, bins of brightness, and the least range of ln brightness (0.7: one stop).
_TONE_RANGE, _TONE_BINS, _TONE_SPAN = (0.01, 0.9), 8, 0.7
TILE = 16  # px
_LEAST_TILES = 30
_MOST_SIGMA, _MOST_SIGMA_OF_SUM = 0.01, 0.03  # relative 1σ of a ratio: of one channel, of all channels together
_LEAST_VIGNETTING = 0.01  # smaller changes of the ratio over the picture are below the limit for ghosts
_DIM, _DIMMEST = 4e-3, 4e-4  # of the sensor's range: darker tiles suffer from errors of the black level
# For the black level: least ratio of two exposures; least error that is corrected [sensor's range]; difference between
# frames, relative and absolute, up to which they agree. Good captures reach 2e-5 (docs/benchmarks/gates.md).
_BLACK_STEP, _LEAST_BLACK, _BLACK_AGREES = 1.3, 1e-4, (0.1, 5e-5)
_AS_STATED = 1.3  # largest factor between the measured exposure and that of the settings
# For flicker: tiles along a column of the picture; their least side [px]; least lit rows; least lit tiles of a row
_FLICKER_ROWS, _LEAST_FLICKER_TILE, _LEAST_ROWS, _LEAST_IN_ROW = 60, 4, 12, 4
_LEAST_LIGHT = 0.01  # of the expected light; tiles with less count as this
_UNLIT, _LEAST_RATIO = 0.01, 1e-4  # share of the stated light below which a frame is unlit; least ratio of such a frame
_TILE_NOISE = (1e-7, 0.005, 3e-6)  # of a tile's mean: variance per signal, relative 1σ, 1σ of a black tile


def of_frame(name: str, tiles: tuple[Floats, Floats], frame: Frame, reference: Frame) -> Floats:
    """Exposure ratio (C,) float32 of a frame to the reference frame, measured, or else as stated.

    `tiles` are the `common_tiles` (T, C) of reference frame and frame. A ratio from EXIF does not count if the flash
    fired.

    Raises CaptureError: the frame `name` has neither a measured nor a stated ratio.
    """
    measured = of_tiles(*tiles)
    if measured is not None:
        return measured.astype(np.float32)
    ratio = stated(frame, reference)
    unlit = of_unlit(*tiles, ratio)
    by_hand = frame.exposure is not None and reference.exposure is not None
    if unlit is None and (not np.isfinite(ratio) or (frame.exif.flash_fired and not by_hand)):
        why = "it states no exposure"
        if np.isfinite(ratio):
            why = "the flash fired, so its shutter time does not set the exposure"
        raise CaptureError(
            f"{name} shares too few well exposed pixels with the reference frame to measure its exposure, "
            f"and {why}; state `exposure` in capture.toml, or leave the frame out, with the same exposure of every shot"
        )
    return np.full(tiles[0].shape[1], ratio if unlit is None else unlit, np.float32)


def of_tiles(a: Floats, b: Floats) -> Floats | None:
    """Measure the exposure ratio b / a (C,) of two frames from `common_tiles` (T, C); None for too few bright ones.

    It is the quotient of sums over tiles: the maximum-likelihood estimate for Poisson counts, without the bias of a
    mean of quotients or of logarithms. Tiles that disagree, because something moved, are left out. A channel with an
    error above 1 % gets the ratio of all channels together.
    """
    found = [_quotient(a[:, c], b[:, c]) for c in range(a.shape[1])]
    of_sum = _quotient(a.sum(axis=1), b.sum(axis=1))
    if of_sum is None or of_sum[1] > _MOST_SIGMA_OF_SUM:
        return None
    return np.array([one[0] if one is not None and one[1] < _MOST_SIGMA else of_sum[0] for one in found])


def common_tiles(reference: Signals, other: Signals) -> tuple[Floats, Floats]:
    """Means (T, C) of tiles in both frames, for the tiles that are fully usable in both."""
    return in_common(tiles(reference), tiles(other))


def tiles(picture: Signals, size: int = TILE) -> tuple[Floats, Bools]:
    """Means (rows, columns, C) of all tiles of a frame, and which tiles (rows, columns) are fully usable."""
    return tile_means(picture, size).astype(np.float64), block_means(picture.usable, size) == 1


def in_common(first: tuple[Floats, Bools], second: tuple[Floats, Bools]) -> tuple[Floats, Floats]:
    """Means (T, C) of the tiles that are fully usable in both of two frames, by their `tiles`."""
    inside = first[1] & second[1]
    return first[0][inside], second[0][inside]


def black_error(tiles: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Measure the error of the stated black level, (C,) of the sensor's range, > 0 if too low; from `common_tiles`.

    A level that is too low by δ adds δ to every frame, so that b = r a + (1 − r) δ: δ follows from the intercept of a
    line, and its slope r (N,) is the exposure ratio, NaN for too few tiles. The error is 0 where it is below 1e-4, or
    where the frames disagree.
    """
    lines = [_fit_lines(a, b) if len(a) >= _LEAST_TILES else np.full((2, a.shape[1]), np.nan) for a, b in tiles]
    ratio = np.array([slope.mean() for slope, _ in lines])
    known = [offset / (1 - slope) for slope, offset in lines if (np.abs(np.log(slope)) > np.log(_BLACK_STEP)).all()]
    if not known:
        return np.zeros(1), ratio
    error = np.mean(known, axis=0)
    share, least = _BLACK_AGREES
    agree = np.ptp(known, axis=0) <= share * np.abs(error) + least
    return np.where((np.abs(error) > _LEAST_BLACK) & agree, error, 0.0), ratio


def _fit_lines(a: Floats, b: Floats) -> Floats:
    """Slope and intercept (2, C) of b over a by robust least squares, for each channel of T tiles (T, C).

    Tiles where something moved get less weight, in ten iterations.
    """
    shot, relative, dark = _TILE_NOISE
    line = np.empty((2, a.shape[1]))
    for c in range(a.shape[1]):
        accuracy = 1 / np.sqrt(shot * np.maximum(b[:, c], 0) + (relative * b[:, c]) ** 2 + dark**2)  # 1/σ
        weight = accuracy
        for _ in range(10):
            matrix = np.stack([a[:, c] * weight, weight], axis=1)
            line[:, c] = np.linalg.lstsq(matrix, b[:, c] * weight, rcond=None)[0]
            residual = (b[:, c] - line[0, c] * a[:, c] - line[1, c]) * accuracy  # in σ
            weight = accuracy * np.sqrt(biweight(residual, spread(residual)))
    line[0] = np.maximum(line[0], 1e-9)  # its logarithm is needed
    return line


def scales_as_stated(ratio: float, frame: Frame, reference: Frame) -> bool:
    """Whether a measured exposure ratio is that of the camera settings, so that steady light has the same ratio."""
    return bool(abs(np.log(ratio / _by_settings(frame, reference))) < np.log(_AS_STATED))  # False if they are unknown


def vignetting(reference: Signals, other: Signals, ratio: Floats) -> Floats | None:
    """Measure the change of vignetting between two frames: a factor (H, W) float32 on their exposure ratio (C,).

    Wide apertures darken the corners, so frames of a bracket by aperture differ. The factor is the exponential of a
    quadratic in x and y. None if it is within 1 % of 1 everywhere, or if too few tiles are bright.
    """
    _, height, width = reference.shape
    a, b = tile_means(reference, TILE).sum(-1), (tile_means(other, TILE) / ratio).sum(-1)
    usable = block_means((reference.usable & other.usable).astype(np.float32), TILE) > 0.999
    bright = usable & (a > 3 * _DIM) & (b > 3 * _DIM)  # sums of three channels
    if bright.sum() < 2 * _LEAST_TILES:
        return None
    row, column = np.nonzero(bright)
    change = np.log(b[bright] / a[bright])
    basis = _quadratic((column + 0.5) / a.shape[1], (row + 0.5) / a.shape[0])
    weight = np.ones(len(change))
    for _ in range(6):  # tiles where something moved lose their weight
        found = np.linalg.lstsq(basis * weight[:, None], change * weight, rcond=None)[0]
        residual = np.abs(change - basis @ found)
        weight = np.sqrt(1 / (1 + (residual / (2 * MAD_TO_SIGMA * np.median(residual) + 1e-4)) ** 2))  # Cauchy's, at 2σ
    if np.abs(basis @ found).max() < _LEAST_VIGNETTING:
        return None
    y, x = np.mgrid[:height, :width].astype(np.float32)
    logarithm = _quadratic((x.ravel() + 0.5) / (a.shape[1] * TILE), (y.ravel() + 0.5) / (a.shape[0] * TILE)) @ found
    return np.asarray(np.exp(logarithm).reshape(height, width), np.float32)


def _quadratic(x: Floats, y: Floats) -> Floats:
    """Design matrix of a quadratic surface: columns 1, x, y, x², xy, y² of points (N,)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def of_unlit(a: Floats, b: Floats, stated: float) -> float | None:
    """Exposure ratio b / a of an unlit frame b, from tiles (T, C), with the ratio `stated` by capture.toml or settings.

    None if b has more than 1 % of the light that is expected from `stated`, or if light is expected in too few tiles.
    """
    a, b = a.sum(axis=1), b.sum(axis=1)
    bright = stated * a > _DIM
    if bright.sum() < _LEAST_TILES or b[bright].sum() > _UNLIT * stated * a[bright].sum():
        return None
    return max(float(b[bright].sum() / a[bright].sum()), _LEAST_RATIO)


def stated(frame: Frame, reference: Frame) -> float:
    """Exposure ratio to the reference frame by capture.toml, else by camera settings; NaN if unknown."""
    if frame.exposure and reference.exposure:
        return frame.exposure / reference.exposure
    return _by_settings(frame, reference)


def of_ambient(frame: Frame, reference: Frame) -> float:
    """Ratio of the exposures to ambient light, frame to reference frame, by camera settings; 1 if unknown."""
    settings = _by_settings(frame, reference)
    return settings if np.isfinite(settings) else 1.0


def _by_settings(frame: Frame, reference: Frame) -> float:
    """Exposure ratio to the reference frame by the camera settings; NaN if unknown."""
    a, b = frame.exif.relative_exposure, reference.exif.relative_exposure
    return a / b if a and b else float("nan")


def curvature(a: Floats, b: Floats) -> float:
    """Measure the nonlinearity of two frames: change of their exposure ratio with brightness, d ln(b/a) / d ln √(a b).

    `a` and `b` (T, C) are tiles of `common_tiles`. The result is 0 for linear files. A tone curve makes the ratio
    differ between shadows and highlights; a change of the light does not. NaN if the tiles differ too little in
    brightness.
    """
    a, b = a.mean(axis=1), b.mean(axis=1)
    lit = (a > _TONE_RANGE[0]) & (b > _TONE_RANGE[0]) & (a < _TONE_RANGE[1]) & (b < _TONE_RANGE[1])
    if lit.sum() < 4 * _LEAST_TILES:
        return float("nan")
    level, change = (np.log(a[lit]) + np.log(b[lit])) / 2, np.log(b[lit] / a[lit])
    bins = np.array_split(np.argsort(level.round(6), kind="stable"), _TONE_BINS)
    x, y = (np.array([np.median(values[one]) for one in bins]) for values in (level, change))
    if np.ptp(x) < _TONE_SPAN:
        return float("nan")
    return float(np.polyfit(x, y, 1)[0])


def flicker(reference: Signals, other: Signals) -> float:
    """Measure flickering light: RMS change of two frames' exposure ratio from row to row, relative; NaN if unknown.

    A shutter exposes a picture row after row, so flicker changes the ratio from row to row only. Other causes (a room's
    light, motion, an error of the black level) change it from column to column as well. So the variance of the column
    medians is subtracted from that of the row medians, and twice the 1σ of their difference, too.
    """
    size = min(max(reference.shape[1] // _FLICKER_ROWS, _LEAST_FLICKER_TILE), TILE)
    (a, inside), (b, other_inside) = tiles(reference, size), tiles(other, size)
    a, b = a.sum(axis=-1), b.sum(axis=-1)
    lit = inside & other_inside & (a > 3 * _DIM)  # sums of three channels
    expected = a * (np.median(b[lit] / a[lit]) if lit.any() else 0)
    lit &= expected > 3 * _DIM
    change = np.full(a.shape, np.nan)
    change[lit] = np.log(np.maximum(b[lit] / expected[lit], _LEAST_LIGHT))  # a shutter may hide rows from the flash
    (rows, sigma), (columns, other_sigma) = _variance_of_rows(change), _variance_of_rows(change.T)
    return float(np.sqrt(max(rows - columns - 2 * np.hypot(sigma, other_sigma), 0.0)))


def _variance_of_rows(change: Floats) -> tuple[float, float]:
    """Variance of the row medians of `change` about a parabola, less their noise, and its 1σ; NaN for too few rows."""
    change = change[np.isfinite(change).sum(axis=1) >= _LEAST_IN_ROW]
    if len(change) < _LEAST_ROWS:
        return float("nan"), float("nan")
    median = np.nanmedian(change, axis=1)
    sigma = MAD_TO_SIGMA * np.nanmedian(np.abs(change - median[:, None]), axis=1)
    variance = (MEDIAN_SE * sigma) ** 2 / np.isfinite(change).sum(axis=1)  # of a median
    row = np.arange(len(median))
    residual = median - np.polyval(np.polyfit(row, median, 2), row)  # apertures differ in vignetting
    noise = float(np.mean(variance))
    return float(np.mean(residual**2)) - noise, noise * float(np.sqrt(2 / len(residual)))


def _quotient(a: Floats, b: Floats) -> tuple[float, float] | None:
    """Exposure ratio Σb / Σa over the tiles (T,) that agree, and its relative 1σ; None for too few tiles."""
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
    agree = np.ones(len(a), bool)
    for _ in range(6):
        error = (b - r * a) / np.sqrt(b)  # uniform noise if there is photon noise only
        scale = MAD_TO_SIGMA * float(np.median(np.abs(error)))
        agree = np.abs(error) <= 4 * scale + 0.003 * np.sqrt(b)  # 4σ plus 0.3 % of b
        if agree.sum() < _LEAST_TILES / 2:
            return None
        r = float(b[agree].sum() / a[agree].sum())
    residual = b[agree] - r * a[agree]
    return r, float(np.sqrt(np.sum(residual**2)) / b[agree].sum())
