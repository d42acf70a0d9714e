"""Reads and writes color profiles (TOML): the color matrix of a chart, for captures without one.

Each result with a chart has its profile; `--chart FILE` uses it for another capture.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.chart_values import ColorCalibration, PatchColors
from polcap.errors import ChartError
from polcap.formats import atomic, text_file

NAME = "color.toml"  # in a result folder
_OfPatches = Meta(min_length=24, max_length=24)
_Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]


class _Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of a color profile file: a `ColorCalibration` without its place, and its patches as single keys."""

    matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    source: Literal["chart", "corners", "profile", "camera", "none"]
    cost: float = float("nan")
    delta_e: Annotated[list[float], _OfPatches] | None = None
    metres_per_px: _Finite | None = None
    falloff: tuple[_Finite, _Finite] = (0.0, 0.0)
    glare: _Finite = 0.0
    predicted: Annotated[list[float], _OfPatches] | None = None
    patch_use: Annotated[list[Annotated[int, Meta(ge=0, le=255)]], _OfPatches] | None = None


def write(path: Path, color: ColorCalibration) -> None:
    """Write a color matrix as a profile file for other captures of the same camera, light and exposure."""
    document = {name: getattr(color, name) for name in ("matrix", "source", "cost", "metres_per_px")}
    if (patches := color.patches) is not None:
        document |= {name: getattr(patches, name) for name in ("delta_e", "falloff", "glare", "predicted")}
        document["patch_use"] = patches.use
    head = (
        "# polcap color profile. matrix: camera radiance (I0 + I90) -> linear Rec.709 reflectance.\n"
        "# metres_per_px: at the chart's distance.\n"
    )
    atomic.write(path, head + text_file.to_toml(document))


def read(path: Path) -> ColorCalibration:
    """Read a color profile that `write` wrote. Raises ChartError."""
    document: dict[str, Any] = {}
    try:
        document = text_file.read_toml(path, finite=False)
        profile = msgspec.convert(document, _Profile)
    except OSError as error:
        raise ChartError(f"{path}: cannot be read ({error.strerror}); give a profile's path") from error
    except ValueError as error:
        fault: object = error
        if isinstance(error, msgspec.ValidationError):
            fault = text_file.fault(error, document, _Profile)
        raise ChartError(f"{path}: not a polcap color profile ({fault}); write the profile again") from error
    matrix = np.array(profile.matrix)
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix, rtol=1e-6) < 3:
        raise ChartError(f"{path}: its color matrix cannot be inverted; write the profile again")
    patches = None
    if profile.delta_e is not None:
        use = None if profile.patch_use is None else np.array(profile.patch_use, np.uint8)
        predicted = None if profile.predicted is None else np.array(profile.predicted)
        patches = PatchColors(np.array(profile.delta_e), use, predicted, profile.falloff, profile.glare)
    metres = profile.metres_per_px
    return ColorCalibration(matrix, profile.source, cost=profile.cost, metres_per_px=metres, patches=patches)
