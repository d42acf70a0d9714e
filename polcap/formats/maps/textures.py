"""In: the folder of a texture set. Out: linear albedo, roughness and relief on one square grid."""

from pathlib import Path

import cv2
import numpy as np

from polcap.errors import DecodeError
from polcap.images import Floats
from polcap.optics import color


def read(folder: Path, side: int = 256) -> Floats:
    """Linear albedo, roughness and the relief's slopes along columns and rows, (6, side, side).

    albedo.jpg (sRGB) and roughness.jpg must be there; normal.jpg (tangent space, green down as in DirectX) or
    height.jpg may be.

    Raises
    ------
    DecodeError
        A picture is missing or cannot be read.
    """
    albedo = _picture(folder / "albedo.jpg", side)[..., ::-1]
    linear = color.decode_srgb(albedo)
    rough = _picture(folder / "roughness.jpg", side).mean(axis=-1)
    slope: Floats = np.zeros((side, side, 2), dtype=np.float32)
    if (folder / "normal.jpg").exists():
        n = _picture(folder / "normal.jpg", side)[..., ::-1] * 2 - 1
        slope = -n[..., :2] / np.maximum(n[..., 2:], 0.3)
    elif (folder / "height.jpg").exists():
        height = _picture(folder / "height.jpg", side).mean(axis=-1)
        slope = np.stack([np.roll(height, -1, a) - np.roll(height, 1, a) for a in (1, 0)], axis=-1) * side / 64
    maps = np.concatenate([linear, rough[..., None], np.clip(slope, -2, 2)], axis=-1)
    return np.ascontiguousarray(maps.transpose(2, 0, 1), dtype=np.float32)


def _picture(path: Path, side: int) -> Floats:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise DecodeError(f"{path} is missing or no picture; a texture set is a folder with albedo.jpg, roughness.jpg")
    return np.asarray(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA), dtype=np.float32) / 255
