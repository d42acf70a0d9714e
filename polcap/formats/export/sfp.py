"""Writes a result for codes of shape from polarization: pictures at four angles, cues, normals and camera matrix.

`sfp.mat` has the variables images, angles, mask and spec, as waps101/depth-from-polarisation loads them; the PNGs and
`K.txt` are for all other codes. The pictures come from the Stokes parameters, so they are registered, without the gains
of the shots and without the lens's distortion, whatever angles were photographed.

References
----------
Smith et al., Linear depth estimation from an uncalibrated, monocular polarisation image, ECCV 2016.
"""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from polcap.formats import atomic
from polcap.formats.maps import maps_folder, png, result_maps
from polcap.image_values import Floats
from polcap.optics import mueller

ANGLES_DEG = (0, 45, 90, 135)
_MAT_TEXT = 116  # bytes of free text at the start of a MAT-file, version 5; SciPy puts the time there
_README = (
    "Angles: degrees (sfp.mat: rad) from image x (right) towards image up, counter-clockwise as seen; I(angle) = "
    "(S0 + S1 cos 2 angle + S2 sin 2 angle)/2. polNNN.png: 16 bit, linear, camera RGB, 65535 = {white:.6g} of the "
    "sensor's white; dolp.png: 16 bit, DoLP = value/65535; aolp.png: 16 bit, AoLP = 180 value/65536 degrees; "
    "normal.png: 16 bit, n = value/32767.5 - 1, x right, y up, z toward the camera; mask.png: 255 = object; K.txt: "
    "camera matrix in px, for x right, y down, z ahead, row 0 on top, pixel centers on whole numbers; sfp.mat: images "
    "(mean of RGB), angles, mask, spec, dolp, aolp, normal, K; spec (pixels of mirrored light) is empty, as under a "
    "flash at the lens.\n"
)


def write(folder: Path, maps: Path, comment: str = "") -> list[Path]:
    """Write the folder from the folder maps/ of a result; `comment` goes into README.txt. Raises DecodeError."""
    found, stokes, cues = maps_folder.read(maps), result_maps.read_stokes(maps), result_maps.read_cues(maps)
    angle = np.radians(ANGLES_DEG)
    shots = np.einsum("ks,shwc->khwc", mueller.analyzer(angle), stokes.astype(np.float64))
    white = float(shots.max()) or 1.0
    levels = {f"pol{degrees:03d}.png": shot / white for degrees, shot in zip(ANGLES_DEG, shots)}
    levels |= {"dolp.png": cues["dolp"], "normal.png": np.where(found.mask[..., None], found.normal / 2 + 0.5, 0)}
    pictures = {name: png.sixteen_bits(level) for name, level in levels.items()}
    pictures["aolp.png"] = np.asarray(np.rint(cues["aolp"] / np.pi * 65536) % 65536, np.uint16)
    pictures["mask.png"] = np.where(found.mask, 255, 0).astype(np.uint8)
    for name, picture in pictures.items():
        png.write(folder / name, picture)
    table = "".join(f"{' '.join(f'{value:.6f}' for value in row)}\n" for row in found.view.intrinsic)
    variables = {
        "images": np.moveaxis(shots.mean(axis=-1), 0, -1),
        "angles": angle[None],
        "mask": found.mask,
        "spec": np.zeros_like(found.mask),
        "dolp": cues["dolp"],
        "aolp": cues["aolp"],
        "normal": found.normal,
        "K": found.view.intrinsic,
    }
    texts: dict[str, str | bytes] = {
        "K.txt": table,
        "README.txt": _README.format(white=white) + "".join(f"{line}\n" for line in comment.splitlines()),
        "sfp.mat": _mat(variables),
    }
    for file, content in texts.items():
        atomic.write(folder / file, content)
    return [folder / name for name in (*pictures, *texts)]


def _mat(variables: dict[str, Floats]) -> bytes:
    """A MAT-file, version 5, of arrays by name; the same arrays give the same bytes."""
    from scipy.io import savemat

    buffer = BytesIO()
    target: Any = buffer  # SciPy's types allow paths only
    savemat(target, variables, do_compression=True)
    return b"MATLAB 5.0 MAT-file, written by polcap".ljust(_MAT_TEXT) + buffer.getvalue()[_MAT_TEXT:]
