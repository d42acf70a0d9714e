"""In: maps of an object. Out: the same with fewer pixels; means are over the object alone."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, SurfaceMaps

_LEAST_SHARE = 1e-3  # of a pixel that the object covers, from which a mean is taken


class Smaller:
    """The way from one grid to a smaller one, for images of an object on the former."""

    def __init__(self, inside: NDArray[np.bool_], longest: int) -> None:
        height, width = inside.shape
        self.inside = inside
        self.factor = min(1.0, longest / max(height, width))
        self.size = (max(1, round(width * self.factor)), max(1, round(height * self.factor)))  # width, height
        self.share = area(inside.astype(np.float32), self.size)  # of each pixel, covered by the object

    def mean(self, image: Floats) -> Floats:
        """Means of (H, W) or (H, W, C) over the object's pixels; 0 where there are none."""
        flat = image.ndim == 2
        total = area(np.where(self.inside if flat else self.inside[..., None], image, 0), self.size)
        weight = self.share if flat else self.share[..., None]
        return np.asarray(np.where(weight > _LEAST_SHARE, total / np.maximum(weight, _LEAST_SHARE), 0), np.float32)

    def maps(self, found: SurfaceMaps) -> SurfaceMaps:
        """All maps but the coarse depth."""
        normal = self.mean(found.normal)
        x, y = ((edge + 0.5) * self.factor - 0.5 for edge in found.view.center)
        left, top = (edge * self.factor for edge in found.view.origin)
        view = replace(
            found.view,
            focal=found.view.focal * self.factor,
            center=(x, y),
            scale=found.view.scale / self.factor,
            origin=(left, top),
        )
        return replace(
            found,
            normal=normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6),
            diffuse=self.mean(found.diffuse),
            specular=self.mean(found.specular),
            roughness=self.mean(found.roughness),
            confidence=self.mean(found.confidence),
            depth_prior=None,
            mask=self.share > 0.5,
            view=view,
        )


def area(image: Floats, size: tuple[int, int]) -> Floats:
    """Averaged down to (width, height); as it is where the size is the same."""
    image = np.ascontiguousarray(image, np.float32)
    return image if image.shape[1::-1] == size else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
