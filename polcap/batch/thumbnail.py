"""Thumbnail of a result for the contact sheet."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polcap.formats import atomic
from polcap.optics.resize import area_mean

_SIDE = 128  # px, of each of the two pictures in a thumbnail


def write(file: Path, result: Path) -> None:
    """Write a JPEG thumbnail of a result folder: normal map and diffuse albedo, side by side."""
    pictures = [_small(result / "maps" / name) for name in ("normal.png", "diffuse.png")]
    _, encoded = cv2.imencode(".jpg", np.hstack(pictures), [cv2.IMWRITE_JPEG_QUALITY, 85])
    atomic.write(file, encoded.tobytes())


def _small(file: Path) -> Any:
    """Read a map's PNG and reduce it to (SIDE, SIDE, 3), black at the right or below; all black if unreadable."""
    out = np.zeros((_SIDE, _SIDE, 3), np.uint8)
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is not None:
        height, width = picture.shape[:2]
        scale = _SIDE / max(height, width)
        shape = max(1, round(height * scale)), max(1, round(width * scale))
        out[: shape[0], : shape[1]] = area_mean(picture, shape)
    return out
