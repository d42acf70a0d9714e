"""Merges the photosites of the reference shot without binning, for detail finer than a superpixel."""

from functools import partial

import numpy as np

from polcap import parallel
from polcap.image_values import Bits, Floats, Mosaic, SensorImage
from polcap.stages.hdr.bracket import Bracket
from polcap.stages.hdr.planes import Reader, blocks
from polcap.stages.hdr.weights import WeightedBracket, WeightedFrame


def merge(bracket: Bracket, weighted: WeightedBracket, cfa: Bits, read: Reader) -> Mosaic:
    """Merge the photosites (2H, 2W) of a Bayer bracket: sum of the signals over sum of the exposures.

    `cfa` (2, 2) is the color filter array. Each superpixel (H, W) uses the same frames as in the merge. Frames that
    moved are left out, because resampling would mix the colors.
    """
    _, height, width = weighted.shape
    signal, exposure = (np.zeros((2 * height, 2 * width), np.float32) for _ in range(2))
    for e, frame in zip([bracket.reference, *bracket.others], weighted.frames, strict=True):
        if frame.frame.motion is None:
            image = read(bracket.shot.frames[e])  # one at a time: memory may have no room for all
            parallel.results(partial(_add, image, frame, signal, exposure, rows) for rows, _, _ in blocks(height))
    value = np.empty(signal.shape, np.float16)
    for rows, _, _ in blocks(2 * height):
        value[rows] = signal[rows] / np.maximum(exposure[rows], np.float32(1e-6))
    return Mosaic(value, cfa)


def _add(image: SensorImage, frame: WeightedFrame, signal: Floats, exposure: Floats, rows: slice) -> None:
    """Add a frame's signals and exposures to those (2H, 2W) of some rows of superpixels."""
    if image.cfa is None:
        return
    width = signal.shape[1]
    used = np.repeat(frame.used[rows], 2, axis=1).astype(np.float32)
    scale = np.float32(image.white - float(image.black.mean()))
    for i in (0, 1):  # rows of photosites of the color filter array's row i
        sites = slice(2 * rows.start + i, 2 * rows.stop, 2)
        black = np.tile(np.broadcast_to(image.black, (2, 2))[i].astype(np.float32), width // 2)
        counts = image.value[sites, :width] - black
        counts *= used
        counts /= scale
        signal[sites] += counts
        exposure[sites] += used * np.tile(frame.frame.ratio[image.cfa[i]], width // 2)
