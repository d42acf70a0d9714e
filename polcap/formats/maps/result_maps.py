"""Reads the maps of a result folder for Python users: `polcap.read_maps`, `read_stokes`, `read_cues` and others."""

from pathlib import Path

import numpy as np

from polcap.errors import DecodeError
from polcap.formats import own_folders
from polcap.formats.maps import exr, maps_folder
from polcap.formats.maps.map_files import STOKES_PAIRS
from polcap.formats.maps.maps_folder import ResultMaps
from polcap.image_values import Floats


def read(result: str | Path) -> ResultMaps:
    """Read all maps of a result: a result folder, its folder maps/, or the capture folder that holds the result.

    Raises DecodeError: a file is missing, damaged, or not of the size in maps.json; or the result is not of one view.
    """
    return maps_folder.read(_folder(result))


def read_stokes(result: str | Path) -> Floats:
    """Linear Stokes parameters S0, S1, S2 of a result, (3, H, W, 3), in camera channels; white of the sensor is 1.

    Raises DecodeError: the file is missing or damaged.
    """
    found = _channels(_folder(result) / "stokes.exr", [f"S{s}.{color}" for s in range(3) for color in "RGB"])
    return np.moveaxis(np.stack(found).reshape(3, 3, *found[0].shape), 1, -1)


def read_stokes_covariance(result: str | Path) -> Floats:
    """Covariance of S0, S1, S2 of a result by noise, (3, 3, H, W, 3), in the squared unit of `read_stokes`.

    It holds the noise of each pixel, not errors that pixels share (gains, angles, registration). Resampling averages
    noise, so it is an upper bound for shots that moved by parts of a pixel.

    Raises DecodeError: the file is missing or damaged.
    """
    file = _folder(result) / "stokes_covariance.exr"
    sigma = [_channels(file, [f"sigma.S{s}.{color}" for color in "RGB"]) for s in range(3)]
    scale = np.moveaxis(np.array(sigma), 1, -1)  # (3, H, W, 3)
    covariance = scale[:, None] * scale[None]
    for i, j in STOKES_PAIRS:
        correlation = np.stack(_channels(file, [f"correlation.S{i}S{j}.{color}" for color in "RGB"]), axis=-1)
        covariance[i, j] *= correlation
        covariance[j, i] *= correlation
    return np.asarray(covariance)


def read_cues(result: str | Path) -> dict[str, Floats]:
    """Polarization cues of a result by name.

    `dolp` (H, W); `aolp` (H, W) rad, 0…π from image x toward image up; `normalized_stokes` (2, H, W);
    `diffuse_color` (H, W, 3) of unit length.

    Raises DecodeError: the file is missing or damaged.
    """
    names = ["dolp", "aolp", "normalized.S1", "normalized.S2", *(f"diffuse_color.{color}" for color in "RGB")]
    dolp, aolp, s1, s2, *rgb = _channels(_folder(result) / "cues.exr", names)
    return {
        "dolp": dolp,
        "aolp": np.radians(aolp),
        "normalized_stokes": np.stack([s1, s2]),
        "diffuse_color": np.stack(rgb, axis=-1),
    }


def _folder(result: str | Path) -> Path:
    """The folder with maps.json that a path names, as for `read`. Raises DecodeError: as `require_picture`."""
    named = Path(result)
    parts = ("", own_folders.OUTPUT, own_folders.FUSED, own_folders.MATERIAL)
    places = [named, *(named / part / "maps" for part in parts)]
    found = next((place for place in places if (place / "maps.json").exists()), named)
    maps_folder.require_picture(found)
    return found


def _channels(file: Path, names: list[str]) -> list[Floats]:
    """Channels (H, W) of an EXR file, in the order of `names`."""
    if not file.exists():
        raise DecodeError(f"{file}: there is no such file; give a result's folder, or process the capture again")
    found = exr.read(file)
    missing = [name for name in names if name not in found]
    if missing:
        raise DecodeError(f"{file} has no channel {missing[0]}; process the capture again")
    return [found[name] for name in names]
