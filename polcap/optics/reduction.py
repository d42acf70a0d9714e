"""Reduces maps of an object to fewer pixels; every mean is taken over the object's pixels only."""

from dataclasses import replace
from typing import Any

import numpy as np

from polcap.image_values import Bools, Floats, View
from polcap.optics import frames
from polcap.optics.resize import area_mean
from polcap.stage_values import SurfaceMaps


class ObjectReduction:
    """Reduction of images (H, W, …) to at most `longest` px a side: means over the object's pixels `inside` (H, W)."""

    def __init__(self, inside: Bools, longest: int) -> None:
        height, width = inside.shape
        self.inside = inside
        self.factor = min(1.0, longest / max(height, width))
        self.shape = (max(1, round(height * self.factor)), max(1, round(width * self.factor)))
        self.share = area_mean(inside, self.shape)  # of each reduced pixel, covered by the object

    def mean(self, image: Floats) -> Floats:
        """Reduce an image (H, W) or (H, W, C) by means over the object's pixels; 0 outside the object."""
        extra = (None,) * (image.ndim - 2)
        inside = np.where(self.inside[..., *extra], image, 0).astype(np.float32, copy=False)
        return np.asarray(area_mean(inside, self.shape) / np.maximum(self.share, 1e-9)[..., *extra])

    def maps(self, maps: SurfaceMaps) -> SurfaceMaps:
        """Reduce all maps of a result; the network's coarse depth is left out."""
        names = ("normal", "diffuse", "specular", "roughness", "confidence", "diffuse_error", "roughness_error")
        reduced: dict[str, Any] = {
            name: self.mean(image) for name in names if (image := getattr(maps, name)) is not None
        }
        reduced["normal"] = frames.unit(reduced["normal"])
        view = scaled_view(maps.view, self.factor)
        return replace(maps, **reduced, view=view, mask=self.share > 0.5, depth_prior=None)


def scaled_view(view: View, factor: float) -> View:
    """The camera of a picture in `factor` times its size."""
    x, y = ((position + 0.5) * factor - 0.5 for position in view.center)
    left, top = (position * factor for position in view.origin)
    return replace(view, focal=view.focal * factor, center=(x, y), scale=view.scale / factor, origin=(left, top))
