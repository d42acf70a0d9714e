"""Makes the maps of a material seamless: their edges are blended over a strip, and keep their contrast.

The strip at the right and lower edge is blended into the opposite strip. A periodic pattern is first cut to a length at
which both strips agree. A mean of two textures has less contrast than either, so its fine part is divided by its
standard deviation.

References
----------
Heitz & Neyret, High-performance by-example noise using a histogram-preserving blending operator, 2018.
"""

from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np

from polcap.image_values import Floats
from polcap.material.height_map import MaterialMaps
from polcap.optics import frames
from polcap.stages import stage

_STRIP = 1 / 6  # of each side
_PERIODIC = 0.5  # largest difference of a periodic pattern's strips at the best length, over the median of all lengths
_LINES = 64  # compared across the strips, about
_CONTRAST = ("normal", "diffuse", "roughness", "height")  # maps with texture; the others are plain means


@stage(version=2)
def tile(maps: MaterialMaps) -> MaterialMaps:
    """The maps without the last strips, such that opposite edges continue each other."""
    changed: dict[str, Any] = {}
    level = replace(maps, height=_level(maps.height))
    texture = np.concatenate([maps.diffuse, maps.normal[..., :2]], axis=-1)
    strips = [max(1, round(_STRIP * side)) for side in maps.seen.shape]
    rows, columns = (_length(np.moveaxis(texture, axis, 0), strips[axis]) for axis in (0, 1))
    for one in fields(maps):
        value = getattr(level, one.name)
        if isinstance(value, np.ndarray):
            blended: Floats = value[:rows, :columns].astype(np.float64)
            for axis in (0, 1):
                blended = _blend(blended, axis, strips[axis], one.name in _CONTRAST)
            # a mask holds where all blended texels do
            changed[one.name] = (blended > 0.999) if value.dtype == bool else blended.astype(np.float32)
    changed["normal"] = frames.unit(changed["normal"]).astype(np.float32)
    for name in ("diffuse", "roughness", "specular"):
        changed[name] = np.clip(changed[name], 0, 1)
    return replace(maps, **changed)


def _level(height: Floats) -> Floats:
    """Heights without the plane that fits them best."""
    rows, columns = height.shape
    y, x = (np.linspace(-1, 1, n) for n in (rows, columns))
    terms = np.stack([a.ravel() for a in np.broadcast_arrays(np.ones_like(height), x[None], y[:, None])], axis=-1)
    plane = np.linalg.lstsq(terms, height.ravel().astype(np.float64), rcond=None)[0]
    return np.asarray(height - (terms @ plane).reshape(rows, columns), np.float32)


def _length(texture: Floats, strip: int) -> int:
    """Rows of a texture (H, W, C) at which the last strip is most like the first; all, if it is not periodic."""
    total = len(texture)
    some = texture[:, :: max(1, texture.shape[1] // _LINES)]
    lengths = np.arange(total - strip, total + 1)
    difference = [float(np.mean((some[:strip] - some[end - strip : end]) ** 2)) for end in lengths]
    best = int(np.argmin(difference))
    return int(lengths[best]) if difference[best] < _PERIODIC * np.median(difference) else total


def _blend(value: Floats, axis: int, strip: int, contrast: bool) -> Floats:
    """Blend the last strip of an image along `axis` into its first strip; returns the image without the last strip."""
    image = np.moveaxis(value, axis, 0)
    length = len(image)
    share = ((np.arange(strip) + 0.5) / strip).reshape(-1, *(1,) * (image.ndim - 1))
    start, end = image[:strip], image[length - strip :]
    mixed = share * start + (1 - share) * end
    if contrast:
        first, last = (one - cv2.GaussianBlur(one, (0, 0), strip / 4) for one in (start, end))  # fine parts
        correlation = np.clip((first * last).sum() / max(np.sqrt((first**2).sum() * (last**2).sum()), 1e-12), 0, 1)
        sigma = np.sqrt(share**2 + (1 - share) ** 2 + 2 * correlation * share * (1 - share))
        mixed += (share * first + (1 - share) * last) * (1 / sigma - 1)
    return np.moveaxis(np.concatenate([mixed, image[strip : length - strip]]), 0, axis)
