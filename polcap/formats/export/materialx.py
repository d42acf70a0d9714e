"""In: an Asset's material. Out: one MaterialX 1.39 document (.mtlx), textures beside it."""

import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from polcap.formats import atomic
from polcap.formats.export import openpbr
from polcap.formats.export.texture_set import Key
from polcap.images import Asset

VERSION = "1.39"


def write(path: Path, asset: Asset, name: str, files: Mapping[Key, str], says: str) -> None:
    """Write a MaterialX document.

    Parameters
    ----------
    path
        The file.
    asset
        Its factors stand in the document, its textures beside it.
    name
        Of the material.
    files
        Names of the textures beside the document.
    says
        Its doc string.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    with atomic.path(path) as temporary:
        temporary.write_text(document(asset, name, files, says), encoding="utf-8")


def document(asset: Asset, name: str, files: Mapping[Key, str], says: str) -> str:
    """The XML: the description's nodes as they stand, and a material that shows the last.

    Parameters
    ----------
    asset, name, files, says
        As in `write`.
    """
    root = ElementTree.Element("materialx", version=VERSION, colorspace="lin_rec709", doc=says)
    nodes = openpbr.describe(asset, files)
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
    """A name that MaterialX and USD take: letters, digits and _, no digit first."""
    cleaned = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{cleaned}" if cleaned[0].isdigit() else cleaned


def _input(one: openpbr.Input) -> ElementTree.Element:
    element = ElementTree.Element("input", name=one.name, type=one.type)
    match one.value:
        case openpbr.Link(node):
            element.set("nodename", node)
        case openpbr.File(file, colorspace):
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
