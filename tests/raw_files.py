"""Writes small RAW files for tests."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.capture_values import Exif
from polcap.formats import dng_writer

RGGB = np.array([[0, 1], [1, 2]], np.uint8)


def write_raw(path: Path, mosaic: NDArray[np.uint16], exif: Exif, black: float = 512, white: int = 15871) -> bytes:
    """Write an uncompressed Bayer DNG; returns its bytes."""
    dng_writer.write(
        path,
        mosaic,
        cfa=RGGB,
        black=black,
        white=white,
        exif=exif,
        color_matrix=np.eye(3),
        as_shot_neutral=np.ones(3),
    )
    return path.read_bytes()
