"""In: a result folder. Out: the small picture of its maps that the contact sheet shows."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polcap.formats import atomic

_SIDE = 128  # px, of each of the two pictures in a thumbnail


def write(file: Path, result: Path) -> None:
    """Normal and diffuse albedo of a result folder, side by side, as a JPEG."""
    pictures = [_small(result / "maps" / name) for name in ("normal.png", "diffuse.png")]
    _, encoded = cv2.imencode(".jpg", np.hstack(pictures), [cv2.IMWRITE_JPEG_QUALITY, 85])
    with atomic.path(file) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _small(file: Path) -> Any:
    """(SIDE, SIDE, 3) of a map's PNG, black around it."""
    out = np.zeros((_SIDE, _SIDE, 3), np.uint8)
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is not None:
        height, width = picture.shape[:2]
        scale = _SIDE / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        out[: size[1], : size[0]] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return out
