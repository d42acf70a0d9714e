"""Preview of a capture: S0, degree and angle of polarization from its middle exposures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import mueller
from polcap.report import stage_pictures as pictures
from polcap.report.sheets import Tile, sheet

NAME = "preview.png"
_FADE = 0.02  # of the brightest, below which no angle is drawn


def write(folder: Path, angle_deg: Sequence[float], small: Sequence[Floats]) -> Path:
    """Write FOLDER/preview.png with S0, DoLP and AoLP side by side, from small pictures (K, h, w)."""
    light = np.stack(small)  # (K, h, w)
    weights = mueller.analyzer(np.radians(angle_deg))  # (K, 3)
    s0, s1, s2 = np.tensordot(np.linalg.pinv(weights), light, axes=1)
    inside = s0 > _FADE * np.percentile(s0, 99.5)
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-6)
    tiles = [
        Tile(pictures.display(np.repeat(s0[..., None], 3, -1)), "S0"),
        *pictures.polarization(dolp, np.arctan2(s2, s1) / 2, inside),
    ]
    file = folder / NAME
    png.write(file, sheet(tiles))
    return file
