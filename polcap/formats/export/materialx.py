"""Writes the material as MaterialX 1.39, and describes it as a graph of OpenPBR nodes for other writers (USD).

In the graph every node comes after the nodes that it takes inputs from; the last one is the surface.

References
----------
Andersson et al., OpenPBR Surface specification 1.1 (specular_weight scales F0 through the index, so
that reflection at grazing stays 1); MaterialX 1.39, standard nodes.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from polcap.formats import atomic
from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.images import Asset
from polcap.optics import color, fresnel

VERSION = "1.39"
_DARKEST = 1e-4  # luminance below which the tint of a specular texel means nothing


@dataclass(frozen=True)
class TextureFile:
    """A texture in the document's folder."""

    name: str
    colorspace: str | None  # None: numbers, not colors


@dataclass(frozen=True)
class NodeOutput:
    """The output of an earlier node."""

    node: str


@dataclass(frozen=True)
class NodeInput:
    """An input of a node: a number, a text, a texture, or the output of an earlier node."""

    name: str
    type: str  # MaterialX type: float, integer, string, color3, vector3, filename
    value: float | int | str | tuple[float, ...] | TextureFile | NodeOutput


@dataclass(frozen=True)
class ShaderNode:
    """One node; `definition` names its MaterialX nodedef."""

    name: str
    category: str
    type: str  # of its output
    definition: str
    inputs: tuple[NodeInput, ...]


def write(path: Path, asset: Asset, name: str, files: Mapping[Key, str], doc: str) -> None:
    """Write a MaterialX document whose textures `files` are in the same folder; `doc` is its doc string.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    with atomic.path(path) as temporary:
        temporary.write_text(document(asset, name, files, doc), encoding="utf-8")


def document(asset: Asset, name: str, files: Mapping[Key, str], doc: str) -> str:
    """The XML of `write`: the nodes of `describe`, and a material that shows the last."""
    root = ElementTree.Element("materialx", version=VERSION, colorspace="lin_rec709", doc=doc)
    nodes = describe(asset, files)
    for node in nodes:
        element = ElementTree.SubElement(root, node.category, name=node.name, type=node.type, nodedef=node.definition)
        for one in node.inputs:
            element.append(_input(one))
    material = ElementTree.SubElement(root, "surfacematerial", name=identifier(name), type="material")
    shader = {"name": "surfaceshader", "type": "surfaceshader", "nodename": nodes[-1].name}
    ElementTree.SubElement(material, "input", shader)
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def identifier(name: str) -> str:
    """A name that MaterialX and USD accept: letters, digits and _, no digit first."""
    cleaned = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{cleaned}" if cleaned[0].isdigit() else cleaned


def _input(one: NodeInput) -> ElementTree.Element:
    element = ElementTree.Element("input", name=one.name, type=one.type)
    match one.value:
        case NodeOutput(node):
            element.set("nodename", node)
        case TextureFile(file, colorspace):
            element.set("value", file)
            if colorspace is not None:
                element.set("colorspace", colorspace)
        case tuple(numbers):
            element.set("value", ", ".join(f"{number:.7g}" for number in numbers))
        case float(number):
            element.set("value", f"{number:.7g}")
        case plain:
            element.set("value", str(plain))
    return element


def describe(asset: Asset, files: Mapping[Key, str]) -> tuple[ShaderNode, ...]:
    """The material's nodes, the surface last.

    The specular texture holds F0/0.08 in color: its luminance becomes specular_weight, F0 over the F0
    of the asset's index; the color divided by its luminance tints.
    """
    weight = SPECULAR_RANGE / float(fresnel.normal_reflectance(asset.ior))
    srgb = "srgb_texture"
    return (
        _image("basecolor", "color3", TextureFile(files["basecolor"], srgb)),
        _image("roughness", "float", TextureFile(files["roughness"], None)),
        _image("normal", "vector3", TextureFile(files["normal"], None)),
        _node(
            "bent_normal", "normalmap", "vector3", "ND_normalmap_float",
            NodeInput("in", "vector3", NodeOutput("normal")),
        ),
        _image("specular", "color3", TextureFile(files["specular"], srgb)),
        _node(
            "luminance", "luminance", "color3", "ND_luminance_color3",
            NodeInput("in", "color3", NodeOutput("specular")),
            NodeInput("lumacoeffs", "color3", tuple(float(c) for c in color.LUMINANCE)),
        ),
        _node(
            "level", "extract", "float", "ND_extract_color3",
            NodeInput("in", "color3", NodeOutput("luminance")),
            NodeInput("index", "integer", 0),
        ),
        _node(
            "weight", "multiply", "float", "ND_multiply_float",
            NodeInput("in1", "float", NodeOutput("level")),
            NodeInput("in2", "float", weight),
        ),
        _node(
            "some_level", "max", "float", "ND_max_float",
            NodeInput("in1", "float", NodeOutput("level")),
            NodeInput("in2", "float", _DARKEST),
        ),
        _node(
            "tint", "divide", "color3", "ND_divide_color3FA",
            NodeInput("in1", "color3", NodeOutput("specular")),
            NodeInput("in2", "float", NodeOutput("some_level")),
        ),
        _node(
            "openpbr", "open_pbr_surface", "surfaceshader", "ND_open_pbr_surface_surfaceshader",
            NodeInput("base_weight", "float", 1.0),
            NodeInput("base_color", "color3", NodeOutput("basecolor")),
            NodeInput("base_metalness", "float", 0.0),
            NodeInput("specular_weight", "float", NodeOutput("weight")),
            NodeInput("specular_color", "color3", NodeOutput("tint")),
            NodeInput("specular_roughness", "float", NodeOutput("roughness")),
            NodeInput("specular_ior", "float", asset.ior),
            NodeInput("geometry_normal", "vector3", NodeOutput("bent_normal")),
        ),
    )  # fmt: skip


def _image(name: str, kind: str, file: TextureFile) -> ShaderNode:
    clamped = tuple(NodeInput(f"{axis}addressmode", "string", "clamp") for axis in "uv")
    return _node(name, "image", kind, f"ND_image_{kind}", NodeInput("file", "filename", file), *clamped)


def _node(name: str, category: str, kind: str, definition: str, *inputs: NodeInput) -> ShaderNode:
    return ShaderNode(name, category, kind, definition, inputs)
