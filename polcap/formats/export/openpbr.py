"""In: an Asset and the files of its textures. Out: its material, OpenPBR in the nodes of MaterialX 1.39.

One description for two writers, `materialx.py` and `usd.py`: a node graph in which every node stands
after those it takes its inputs from; the last one is the surface.

References
----------
Andersson et al., OpenPBR Surface specification 1.1 (specular_weight scales F0 through the index, so
that reflection at grazing stays 1); MaterialX 1.39, standard nodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.images import Asset
from polcap.optics import color, fresnel

_DARKEST = 1e-4  # luminance below which a specular texel's tint means nothing


@dataclass(frozen=True)
class File:
    """A texture beside the document."""

    name: str
    colorspace: str | None  # None: numbers, not colours


@dataclass(frozen=True)
class Link:
    """The output of an earlier node."""

    node: str


@dataclass(frozen=True)
class Input:
    """What goes into a node under a name: a number, a file, or the output of an earlier node."""

    name: str
    type: str  # MaterialX type: float, integer, string, color3, vector3, filename
    value: float | int | str | tuple[float, ...] | File | Link


@dataclass(frozen=True)
class Node:
    """One node; `definition` names its MaterialX nodedef."""

    name: str
    category: str
    type: str  # of its output
    definition: str
    inputs: tuple[Input, ...]


def describe(asset: Asset, files: Mapping[Key, str]) -> tuple[Node, ...]:
    """The material's nodes, the surface last.

    The specular texture holds F0/0.08 in colour: its luminance becomes specular_weight, F0 over that
    of the asset's index; what is left of colour tints.
    """
    weight = SPECULAR_RANGE / float(fresnel.normal_reflectance(asset.ior))
    srgb = "srgb_texture"
    return (
        _image("basecolor", "color3", File(files["basecolor"], srgb)),
        _image("roughness", "float", File(files["roughness"], None)),
        _image("normal", "vector3", File(files["normal"], None)),
        _node("bent_normal", "normalmap", "vector3", "ND_normalmap_float", Input("in", "vector3", Link("normal"))),
        _image("specular", "color3", File(files["specular"], srgb)),
        _node(
            "luminance", "luminance", "color3", "ND_luminance_color3",
            Input("in", "color3", Link("specular")),
            Input("lumacoeffs", "color3", tuple(float(c) for c in color.LUMINANCE)),
        ),
        _node(
            "level", "extract", "float", "ND_extract_color3",
            Input("in", "color3", Link("luminance")),
            Input("index", "integer", 0),
        ),
        _node(
            "weight", "multiply", "float", "ND_multiply_float",
            Input("in1", "float", Link("level")),
            Input("in2", "float", weight),
        ),
        _node(
            "some_level", "max", "float", "ND_max_float",
            Input("in1", "float", Link("level")),
            Input("in2", "float", _DARKEST),
        ),
        _node(
            "tint", "divide", "color3", "ND_divide_color3FA",
            Input("in1", "color3", Link("specular")),
            Input("in2", "float", Link("some_level")),
        ),
        _node(
            "openpbr", "open_pbr_surface", "surfaceshader", "ND_open_pbr_surface_surfaceshader",
            Input("base_weight", "float", 1.0),
            Input("base_color", "color3", Link("basecolor")),
            Input("base_metalness", "float", 0.0),
            Input("specular_weight", "float", Link("weight")),
            Input("specular_color", "color3", Link("tint")),
            Input("specular_roughness", "float", Link("roughness")),
            Input("specular_ior", "float", asset.ior),
            Input("geometry_normal", "vector3", Link("bent_normal")),
        ),
    )  # fmt: skip


def _image(name: str, kind: str, file: File) -> Node:
    clamped = tuple(Input(f"{axis}addressmode", "string", "clamp") for axis in "uv")
    return _node(name, "image", kind, f"ND_image_{kind}", Input("file", "filename", file), *clamped)


def _node(name: str, category: str, kind: str, definition: str, *inputs: Input) -> Node:
    return Node(name, category, kind, definition, inputs)
