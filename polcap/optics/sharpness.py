"""Relative blur of photographs of the same scene, measured in small tiles.

Blur removes fine detail and leaves coarse detail. So the energy of differences over one pixel is compared with that
over four, in four directions, so that motion blur along one of them is found. To convert this ratio to px, the tiles
of the sharpest photograph are blurred until their ratio is equal: no knowledge of the scene is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats, SensorImage
from polcap.optics import sensor
from polcap.optics.resize import block_means
from polcap.optics.robust import MEDIAN_SE
from polcap.optics.tiles import spread_over_cells

TILE = 32  # px of the binned frames
_CELLS, _PER_CELL = (8, 12), 3  # rows and columns of cells in the picture; tiles chosen in each cell
_FINE, _COARSE = 1, 4  # px, distances of the differences
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns: directions of the differences
_BLURS_PX = (0.0, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)  # 1σ: blurs with which the sharpest tiles are compared
_LEAST_TILES = 4
_LEAST_LIGHT = 0.01  # of the sensor's range; in darker tiles noise would count as detail
_SIGNIFICANCE = 0.999  # quantile of Student's t beyond which a loss of detail is significant
_LEAST_BEYOND_SHIFT = 0.1  # least loss of detail (ln) beyond that which a shift explains
_PHASES = 4.0  # effective number of rows with edges in a tile; fewer may share one place within a pixel
_DETAIL = -0.5  # largest ln of fine over coarse energy of a tile with detail; noise has 0


@dataclass(frozen=True)
class Tiles:
    """Small tiles of one photograph, at places that are the same in all photographs."""

    light: Floats  # (T, TILE, TILE) mean of its photosites
    usable: Bools  # (T,) unclipped and bright enough


def places(image: SensorImage, clip: float) -> NDArray[np.int64]:
    """Choose the tiles to compare in one decoded photograph of a capture: corners (T, 2)."""
    return choose_tiles(_mean_light(image), sensor.usable(image, clip))


def take(image: SensorImage, corners: NDArray[np.int64], clip: float) -> Tiles:
    """Cut tiles out of one decoded photograph, and find which are bright enough and unclipped.

    `corners` (T, 2) are (row, column) in binned px, as `places` returns them; `clip` is as in `sensor.clip_count`.
    """
    step = image.superpixel
    margin = 1 if image.cfa is None else len(image.cfa)  # a clipped photosite makes its neighbors unusable
    side, spare = TILE * step, margin // step
    padded = [(margin, margin), (margin, margin), *[(0, 0)] * (image.value.ndim - 2)]
    around = [
        np.pad(image.value[y : y + side, x : x + side], padded, mode="edge")
        if min(y, x) < margin or y + side + margin > image.value.shape[0] or x + side + margin > image.value.shape[1]
        else image.value[y - margin : y + side + margin, x - margin : x + side + margin]
        for y, x in step * corners
    ]
    if not around:
        return Tiles(np.zeros((0, TILE, TILE), np.float32), np.zeros(0, bool))
    strip = replace(image, value=np.concatenate(around))  # tiles have whole CFA periods: the phase is unchanged
    shape = (len(corners), TILE + 2 * spare, TILE + 2 * spare)
    inner = np.s_[:, spare:-spare, spare:-spare]
    light = _mean_light(strip).reshape(shape)[inner]
    sound = sensor.below(strip, sensor.clip_count(image, clip)).reshape(shape)[inner].all((1, 2))
    return Tiles(light, sound & (light.mean((1, 2)) > _LEAST_LIGHT))


def frames_blur(shots: Sequence[Sequence[Tiles]], px: float) -> Floats:
    """Extra blur (K, E) of each frame, 1σ [RAW px], relative to the sharpest of the same exposure; NaN: not measurable.

    `shots` are K brackets of E photographs; `px` is the number of RAW px per px of the tiles.
    """
    each = [
        extra_blur(np.stack([frame.light for frame in frames]), np.stack([frame.usable for frame in frames]))
        for frames in zip(*shots, strict=True)
    ]
    return np.asarray(px * np.stack(each, axis=1))


def _mean_light(image: SensorImage) -> Floats:
    """Mean light (H, W) of the photosites of each binned pixel."""
    if image.superpixel == 2:  # from the counts: ten times as fast as from channels
        black = float(image.black.mean())
        return np.asarray((block_means(image.value.astype(np.float32), 2) - black) / (image.white - black))
    signal = sensor.signal(image)
    return signal[..., 0] if signal.shape[2] == 1 else cv2.transform(signal, np.array([[0.25, 0.5, 0.25]]))


def choose_tiles(light: Floats, usable: Bools) -> NDArray[np.int64]:
    """Corners (T, 2) = (row, column) of the tiles with most detail in each part of a picture (H, W)."""
    rows, columns = light.shape[0] // TILE, light.shape[1] // TILE
    if not rows or not columns:
        return np.zeros((0, 2), np.int64)
    cut = (slice(0, rows * TILE), slice(0, columns * TILE))
    tiled = (rows, TILE, columns, TILE)
    picture = cv2.GaussianBlur(light[cut], (0, 0), 1.0)
    detail = cv2.Sobel(picture, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(picture, cv2.CV_32F, 0, 1) ** 2
    score = detail.reshape(tiled).mean((1, 3)) / np.maximum(picture.reshape(tiled).mean((1, 3)), 1e-3)
    score *= usable[cut].reshape(tiled).all((1, 3))
    return TILE * spread_over_cells(score, _CELLS, _PER_CELL)


def extra_blur(tiles: Floats, usable: Bools) -> Floats:
    """Extra Gaussian blur (K,) of each photograph, 1σ [px], relative to the sharpest one; NaN: not measurable.

    tiles (K, T, n, n) are from K photographs of equal exposure, usable (K, T). A loss of detail counts as 0 if it is
    within the scatter between tiles, or if a shift explains it. Blur itself adds scatter, because tiles with much
    detail lose more; so the least scatter of the photographs is taken.
    """
    from scipy.special import stdtrit  # here: the import takes 0.2 s

    fineness = np.stack([_fineness(shot) for shot in tiles])  # (K, 4, T)
    chosen = usable.all(0) & (fineness.mean((0, 1)) < _DETAIL)
    if chosen.sum() < _LEAST_TILES:
        return np.full(len(tiles), np.nan)
    fineness = fineness[..., chosen]
    sharpest = int(np.argmax(np.median(fineness, axis=2).mean(1)))
    loss = fineness[sharpest] - fineness  # (K, 4, T)
    lost = np.median(loss, axis=2)  # (K, 4)
    scatter = np.delete(loss, sharpest, axis=0).std(axis=2, ddof=1).min(axis=0, initial=np.inf)  # (4,)
    count = loss.shape[2]
    significant = stdtrit(count - 1, _SIGNIFICANCE) * MEDIAN_SE * scatter / np.sqrt(count)
    beyond_shift = np.median(loss - _phase_loss(tiles[sharpest][chosen]), axis=2)
    lost = np.where((lost > significant) & (beyond_shift > _LEAST_BEYOND_SHIFT), lost, 0.0)
    if not lost.any():
        return np.zeros(len(tiles))
    blurred = np.stack([_fineness(_blurred(tiles[sharpest][chosen], sigma)) for sigma in _BLURS_PX])  # (L, 4, T)
    known = np.median(blurred[0] - blurred, axis=2)  # (L, 4), growing
    return np.array([max(np.interp(lost[k, w], known[:, w], _BLURS_PX) for w in range(4)) for k in range(len(tiles))])


def _fineness(tiles: Floats) -> Floats:
    """Logarithm (4, T) of fine over coarse detail of tiles, in four directions; blur lowers it."""
    return np.stack([np.log(_energy(tiles, axis, _FINE) / _energy(tiles, axis, _COARSE)) for axis in _DIRECTIONS])


def _phase_loss(tiles: Floats) -> Floats:
    """Fineness (4, T) that sharp tiles would lose if the camera moved by half a pixel.

    An edge along the rows is sharpest between two rows, and moved by half a pixel it looks blurred. Tiles with edges in
    many rows (or columns) lose nothing, because these lie at all places within a pixel.
    """
    moved = tiles.copy()
    for axis in (1, 2):  # rows, columns
        energy = (np.diff(tiles, axis=axis) ** 2).mean(axis=3 - axis)  # (T, n − 1) of the edges between two rows
        few = energy.sum(axis=1) ** 2 < _PHASES * (energy**2).sum(axis=1)  # (Σ e)² / Σ e²: number of rows with edges
        lines = np.moveaxis(moved, axis, 1)  # a view
        lines[few, 1:] = (lines[few, 1:] + lines[few, :-1]) / 2
    return _fineness(tiles) - _fineness(moved)


def _energy(tiles: Floats, direction: tuple[int, int], lag: int) -> Floats:
    """Mean squared difference (T,) of pixels `lag` px apart in a direction, as a measure of detail."""
    down, across = direction[0] * lag, abs(direction[1]) * lag
    flipped = tiles[:, :, ::-1] if direction[1] < 0 else tiles
    n = tiles.shape[-1]
    difference = flipped[:, down:, across:] - flipped[:, : n - down, : n - across]
    return np.asarray((difference**2).mean((1, 2)) + 1e-12)


def _blurred(tiles: Floats, sigma: float) -> Floats:
    """Tiles blurred by a Gaussian of 1σ = `sigma` px."""
    if not sigma:
        return tiles
    return np.stack([cv2.GaussianBlur(tile, (0, 0), sigma, borderType=cv2.BORDER_REFLECT) for tile in tiles])
