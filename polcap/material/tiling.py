"""Makes the maps of a material seamless: their edges are blended over a strip, and keep their contrast.

The strip at the right and lower edge fades into the opposite one. A mean of two textures has less contrast than either,
so the difference from the mean of the map is divided by the root of the sum of the squared weights.

References
----------
Heitz & Neyret, High-performance by-example noise using a histogram-preserving blending operator, 2018.
"""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from polcap.images import Floats
from polcap.material.height_map import MaterialMaps
from polcap.optics import frames
from polcap.stages import stage

_STRIP = 1 / 6  # of each side
_CONTRAST = ("normal", "diffuse", "roughness", "height")  # maps with texture; the others are plain means


@stage(version=1)
def tile(maps: MaterialMaps) -> MaterialMaps:
    """The maps, smaller by the strip, such that opposite edges continue each other."""
    changed: dict[str, Any] = {}
    level = replace(maps, height=_level(maps.height))
    for one in fields(maps):
        value = getattr(level, one.name)
        if isinstance(value, np.ndarray):
            contrast = one.name in _CONTRAST
            blended: Floats = value.astype(np.float64)
            for axis in (0, 1):
                blended = _blend(blended, axis, contrast)
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


def _blend(value: Floats, axis: int, contrast: bool) -> Floats:
    """An image whose last strip along `axis` has been blended into the first one, and removed."""
    length = value.shape[axis]
    strip = max(1, round(_STRIP * length))
    image = np.moveaxis(value, axis, 0)
    share = ((np.arange(strip) + 0.5) / strip).reshape(-1, *(1,) * (image.ndim - 1))
    mean = image.mean(axis=(0, 1))
    start, end = image[:strip] - mean, image[length - strip :] - mean
    mixed = share * start + (1 - share) * end
    if contrast:
        mixed /= np.sqrt(share**2 + (1 - share) ** 2)
    return np.moveaxis(np.concatenate([mean + mixed, image[strip : length - strip]]), 0, axis)
