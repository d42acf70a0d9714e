"""Writes every map and the Stokes images of a result as layers of one OpenEXR file, in a chosen color space.

Colors are converted to any space or role of the OpenColorIO configuration $OCIO, by default the one built into
OpenImageIO (ACES' CG config); the header names it (chromaticities, colorInteropID). S0, S1 and S2 stay in camera
channels.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polcap.errors import SettingError
from polcap.formats.maps import exr, png
from polcap.formats.raw import photo
from polcap.image_values import Floats

LINEAR_REC709 = "lin_rec709"  # its alias in OpenColorIO configurations
_COLORS = ("diffuse", "specular")  # layers that are converted to the color space
_PLAIN = {"depth": "Z", "roughness": "Y", "confidence": "Y"}  # layers of one channel: its letter
_ERRORS = ("diffuse_error", "roughness_error")  # layers that older results lack
_FLOAT = ("normal", "depth")  # layers of 32 bits; all others are half
MEANINGS = {
    "S0, S1, S2": "linear Stokes parameters in camera channels; sensor white at the reference exposure = 1",
    "normal": "unit vectors in the camera frame: x right, y up, z toward the camera",
    "depth": "distance along the optical axis, growing away from the camera",
    "diffuse": "diffuse albedo rho_d",
    "specular": "specular albedo F0",
    "roughness": "perceptual roughness, alpha = roughness squared",
    "confidence": "expected error of the normal, degrees",
    "diffuse_error": "expected error of diffuse, 1 sigma, mean of the channels",
    "roughness_error": "expected error of roughness, 1 sigma",
    "dolp": "degree of linear polarization",
    "aolp": "angle of linear polarization, degrees, 0 to 180 from image x toward image up",
    "mask": "1 on the object",
}


@dataclass(frozen=True)
class ColorSpace:
    """A color space of the OpenColorIO configuration."""

    name: str
    header: dict[str, exr.Attribute]  # of an EXR in it: Color Interop Forum's name; xy of R, G, B and white; if known


def write(path: Path, maps: Path, color: str, header: Mapping[str, str]) -> None:
    """Write the folder maps/ of a result as layers of one EXR, with colors in the color space or role `color`.

    `header` are texts by key. Raises SettingError: there is no such space. DecodeError: a map is missing or damaged.
    """
    space = find_space(color)
    layers: dict[str, Floats] = {}
    for name in _COLORS:
        found = exr.read(maps / f"{name}.exr")
        converted = convert(np.stack([found[c] for c in "RGB"], axis=-1), space)
        layers |= {f"{name}.{c}": converted[..., k] for k, c in enumerate("RGB")}
    normal = exr.read(maps / "normal.exr")
    layers |= {f"normal.{axis}": normal[c] for axis, c in zip("xyz", "RGB")}
    errors = {name: "Y" for name in _ERRORS if (maps / f"{name}.exr").exists()}
    for name, letter in {**_PLAIN, **errors}.items():
        layers[f"{name}.{letter}"] = exr.read(maps / f"{name}.exr")[letter]
    cues = exr.read(maps / "cues.exr")
    layers |= {f"{name}.Y": cues[name] for name in ("dolp", "aolp")}
    layers["mask.Y"] = (png.read(maps / "mask.png") > 127).astype(np.float32)
    layers |= exr.read(maps / "stokes.exr")
    texts = {**header, **{f"layer {key}": meaning for key, meaning in MEANINGS.items()}}
    texts["colors"] = f"{', '.join(_COLORS)} in {space.name}"
    half = [name for name in layers if not name.startswith(_FLOAT)]
    exr.write(path, layers, exr.described(texts) | space.header, half=half)


def find_space(wanted: str) -> ColorSpace:
    """Look up a color space of the OpenColorIO configuration by role, name or alias. Raises SettingError."""
    import OpenImageIO as oiio

    source = _source()
    config = oiio.ColorConfig(source)
    if config.geterror() or not config.getColorSpaceNames():
        raise SettingError(f"$OCIO {source} cannot be read as an OpenColorIO configuration; correct or unset it")
    name = config.resolve(wanted)
    if name not in config.getColorSpaceNames() or config.isData(name):
        known = ", ".join(sorted([*config.getRoles(), *config.getColorSpaceNames()]))
        raise SettingError(f"--color {wanted} is not a color space or role of {source}; it has {known}")
    chromaticities, identifier = config.get_chromaticities(name), config.get_color_interop_id(name)
    header: dict[str, exr.Attribute] = {"colorInteropID": identifier} if identifier else {}
    return ColorSpace(name, header | ({"chromaticities": tuple(map(float, chromaticities))} if chromaticities else {}))


def convert(rgb: Floats, space: ColorSpace) -> Floats:
    """Convert an image (H, W, 3) from linear Rec.709 to another color space. Raises SettingError."""
    import OpenImageIO as oiio

    source = oiio.ImageBuf(np.ascontiguousarray(rgb, dtype=np.float32))
    done = oiio.ImageBufAlgo.colorconvert(source, LINEAR_REC709, space.name, colorconfig=_source())
    if done.has_error:
        raise SettingError(
            f"cannot convert linear Rec.709 to {space.name} ({photo.reason(done)}); choose another --color or $OCIO"
        )
    return np.asarray(done.get_pixels(oiio.FLOAT), dtype=np.float32)


def _source() -> str:
    return os.environ.get("OCIO") or "ocio://default"
