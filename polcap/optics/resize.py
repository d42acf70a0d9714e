"""Area resizing: reduces an image to fewer pixels, each the mean over the area that it covers."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats


def area_mean(image: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Average an image (H, W) or (H, W, C) down to `shape` (height, width, …).

    A mask becomes the share 0…1 of each pixel that it covers, float32. Other types do not change; integers are rounded.
    An image of this size is returned itself, not a copy.
    """
    if image.dtype == bool:
        image = image.astype(np.float32)
    height, width = shape[:2]
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def weighted_area_mean(image: Floats, weight: NDArray[Any], shape: tuple[int, ...]) -> Floats:
    """`area_mean` of an image (H, W) or (H, W, C) in which each pixel counts by its weight (H, W); 0 where none counts.

    With a mask for the weight, the mean over the part of each area that lies in the mask.
    """
    weight = weight.astype(np.float32)
    extra = (None,) * (image.ndim - 2)
    total = area_mean((image * weight[..., *extra]).astype(np.float32), shape)
    return np.asarray(total / np.maximum(area_mean(weight, shape), 1e-9)[..., *extra])


def block_step(pixels: float, most: float) -> int:
    """Side of the blocks to average so that at most `most` of so many pixels remain; 1 for fewer."""
    return int(np.ceil(np.sqrt(max(pixels / most, 1))))


def block_means(image: NDArray[Any], step: int) -> NDArray[Any]:
    """Means of step × step blocks of an image (H, W) or (H, W, C); incomplete blocks at the end are dropped."""
    height, width = (side // step for side in image.shape[:2])
    return area_mean(image[: height * step, : width * step], (height, width))
