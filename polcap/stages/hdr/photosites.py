"""Merged photosites of the reference shot, which hold detail finer than a superpixel."""

from functools import partial

import numpy as np

from polcap import parallel
from polcap.images import Floats, Mosaic, SensorImage
from polcap.stages.hdr.bracket import Bracket
from polcap.stages.hdr.planes import Bools, Reader, blocks
from polcap.stages.hdr.weights import WeightedBracket

_Part = tuple[SensorImage, Bools, Floats]  # a frame, the superpixels (H, W) it serves, its exposure ratios (C,)


def merge(bracket: Bracket, weighted: WeightedBracket, read: Reader) -> Mosaic:
    """Photosites (2H, 2W) of a Bayer bracket: the sum of the signals over the sum of the exposures.

    Each superpixel uses the frames that serve it in the merge. Frames that moved are left out: resampling would mix
    the colors.
    """
    numbers = [bracket.reference, *bracket.others]
    frames = [(read(bracket.shot.frames[e]), one) for e, one in zip(numbers, weighted.frames, strict=True)]
    still = [(image, one) for image, one in frames if one.frame.motion is None and image.cfa is not None]
    parts = [(image, one.serves, one.frame.ratio) for image, one in still]
    _, height, width = weighted.shape
    value = np.empty((2 * height, 2 * width), np.float16)
    parallel.results(partial(_merge_rows, parts, value, rows) for rows, _, _ in blocks(height))
    cfa = parts[0][0].cfa
    assert cfa is not None
    return Mosaic(value, cfa)


def _merge_rows(parts: list[_Part], out: Floats, rows: slice) -> None:
    """Write the merged photosites of some rows of superpixels to `out` (2H, 2W)."""
    width = out.shape[1]
    serves = [np.repeat(serves[rows], 2, axis=1).astype(np.float32) for _, serves, _ in parts]
    for i in (0, 1):  # rows of one phase of the color filter array
        places = slice(2 * rows.start + i, 2 * rows.stop, 2)
        signal, exposure = (np.zeros((len(serves[0]), width), np.float32) for _ in range(2))
        for (image, _, ratio), weight in zip(parts, serves):
            assert image.cfa is not None
            black = np.tile(np.broadcast_to(image.black, (2, 2))[i].astype(np.float32), width // 2)
            part = image.value[places, :width] - black
            part *= weight
            part /= np.float32(image.white - float(image.black.mean()))
            signal += part
            exposure += weight * np.tile(ratio[image.cfa[i]], width // 2)
        out[places] = signal / np.maximum(exposure, np.float32(1e-6))
