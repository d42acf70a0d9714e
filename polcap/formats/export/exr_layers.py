"""In: the folder maps/ of a result. Out: one OpenEXR file with every map and the Stokes images as layers.

Colours may go to another colour space; the file says which (chromaticities, colorInteropID). S0, S1
and S2 stay in camera channels.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from polcap.formats.export import ocio
from polcap.formats.maps import exr, png
from polcap.images import Floats

_COLORS = ("diffuse", "specular")
_PLAIN = {"depth": "Z", "roughness": "Y", "confidence": "Y"}
_WHOLE = ("normal", "depth")  # layers in float; all others in half
SAYS = {
    "S0, S1, S2": "linear Stokes parameters in camera channels; sensor white at the reference exposure = 1",
    "normal": "unit vectors in the camera frame: x right, y up, z toward the camera",
    "depth": "distance along the optical axis, growing away from the camera",
    "diffuse": "diffuse albedo rho_d",
    "specular": "specular albedo F0",
    "roughness": "perceptual roughness, alpha = roughness squared",
    "confidence": "expected error of the normal, degrees",
    "dolp": "degree of linear polarization",
    "aolp": "angle of linear polarization, degrees, 0 to 180 from image x toward image up",
    "mask": "1 on the object",
}


def write(path: Path, maps: Path, color: str, says: Mapping[str, str]) -> None:
    """Write every map of a result as the layers of one OpenEXR file.

    Parameters
    ----------
    path
        The file.
    maps
        Folder with the maps, as `formats.maps.write` leaves it.
    color
        Space or role of the OpenColorIO configuration that the colors are converted to.
    says
        Header entries: where the result comes from.

    Raises
    ------
    SettingError
        There is no such space.
    DecodeError
        A map is missing or damaged.
    StorageError
        The file cannot be written.
    """
    space = ocio.find(color)
    layers: dict[str, Floats] = {}
    for name in _COLORS:
        found, _ = exr.read(maps / f"{name}.exr")
        converted = ocio.convert(np.stack([found[c] for c in "RGB"], axis=-1), space)
        layers |= {f"{name}.{c}": converted[..., k] for k, c in enumerate("RGB")}
    normal, _ = exr.read(maps / "normal.exr")
    layers |= {f"normal.{axis}": normal[c] for axis, c in zip("xyz", "RGB")}
    for name, letter in _PLAIN.items():
        layers[f"{name}.{letter}"] = exr.read(maps / f"{name}.exr")[0][letter]
    cues, _ = exr.read(maps / "cues.exr")
    layers |= {f"{name}.Y": cues[name] for name in ("dolp", "aolp")}
    layers["mask.Y"] = (png.read(maps / "mask.png") > 127).astype(np.float32)
    layers |= exr.read(maps / "stokes.exr")[0]
    exr.write(path, layers, _attributes(space, says), half=[name for name in layers if not name.startswith(_WHOLE)])


def _attributes(space: ocio.Space, says: Mapping[str, str]) -> dict[str, exr.Attribute]:
    attributes: dict[str, exr.Attribute] = {f"polcap:{key}": value for key, value in says.items()}
    attributes |= {f"polcap:layer {key}": value for key, value in SAYS.items()}
    attributes["polcap:colors"] = f"{', '.join(_COLORS)} in {space.name}"
    if space.interop_id is not None:
        attributes["colorInteropID"] = space.interop_id
    if space.chromaticities is not None:
        attributes["chromaticities"] = space.chromaticities
    return attributes
