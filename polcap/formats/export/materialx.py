"""Describes an asset's material by a MaterialX 1.39 document with OpenPBR, from the template `openpbr.mtlx`.

In the document every node comes after the nodes that it takes inputs from. The specular texture holds the color
F0/0.08. Its luminance gives specular_weight: F0 over the F0 of the asset's refractive index. The color divided by its
luminance is the tint.

References
----------
Andersson et al., OpenPBR Surface specification 1.1 (specular_weight scales F0 through the index, so that reflection at
grazing stays 1); MaterialX 1.39, standard nodes.
"""

import re
from collections.abc import Mapping
from importlib.resources import files as resources
from pathlib import Path
from string import Template
from xml.sax.saxutils import quoteattr

from polcap.formats import atomic
from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.mesh_values import Asset
from polcap.optics import color, fresnel

VERSION = "1.39"
_DARKEST = 1e-4  # luminance below which the tint of a specular texel means nothing


def document(asset: Asset, name: str, files: Mapping[Key, str], doc: str) -> str:
    """The XML of a MaterialX document; its textures `files` are in the same folder, `doc` is its doc string."""
    template = resources("polcap.formats.export").joinpath("openpbr.mtlx").read_text(encoding="utf-8")
    return Template(template).substitute(
        {key: quoteattr(file) for key, file in files.items()},
        doc=quoteattr(doc),
        space="lin_rec709" if files["basecolor"].endswith(".exr") else "srgb_texture",
        name=identifier(name),
        luminance=", ".join(f"{weight:.7g}" for weight in color.LUMINANCE),
        weight=f"{SPECULAR_RANGE / float(fresnel.normal_reflectance(asset.ior)):.7g}",
        darkest=f"{_DARKEST:.7g}",
        ior=f"{asset.ior:.7g}",
    )


def write(path: Path, asset: Asset, files: Mapping[Key, str], doc: str) -> None:
    """Write the MaterialX document of an asset, named after the file; otherwise as `document`."""
    atomic.write(path, document(asset, path.stem, files, doc))


def identifier(name: str) -> str:
    """A name that MaterialX and USD accept: letters, digits and _, no digit first."""
    cleaned = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{cleaned}" if cleaned[0].isdigit() else cleaned
