"""Encodes an asset as binary glTF 2.0 (GLB).

The camera frame is that of glTF: right-handed, y up, the viewer on +z, metres. The object is moved to the origin; its
place in the mesh's frame is in `asset.extras`. The provenance is in an XMP packet.

References
----------
Khronos, glTF 2.0; KHR_materials_specular; KHR_materials_ior; KHR_xmp_json_ld; EXT_texture_webp; KHR_texture_basisu.
"""

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from polcap import __version__
from polcap.formats import addresses
from polcap.formats.export import encoders, glb_geometry, texture_set
from polcap.formats.export.encoders import Kind, TextureEncoder
from polcap.formats.export.glb_geometry import Blob, Geometry
from polcap.formats.export.texture_set import Texture
from polcap.formats.maps import maps_folder
from polcap.image_values import Floats
from polcap.mesh_values import Asset, Mesh

_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071  # numbers of OpenGL: filters, and wrapping clamped to the edge
_IMAGE_EXTENSION: dict[Kind, str] = {"webp": "EXT_texture_webp", "ktx2": "KHR_texture_basisu"}
_CONTEXT = {
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "dc": "http://purl.org/dc/elements/1.1/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "xmpRights": "http://ns.adobe.com/xap/1.0/rights/",
    "polcap": "urn:polcap:provenance:1",
}


def _alternatives(text: str) -> dict[str, Any]:
    """A text of XMP in its default language."""
    return {"@type": "rdf:Alt", "rdf:_1": {"@language": "x-default", "@value": text}}


_CATALOG: Mapping[str, tuple[str, Callable[[str], Any]]] = {  # fields of `CatalogEntry` as XMP terms
    "title": ("dc:title", _alternatives),
    "creator": ("dc:creator", lambda text: {"@list": [text]}),
    "rights": ("dc:rights", _alternatives),
    "object_number": ("dc:identifier", str),
    "date": ("dc:date", lambda text: {"@list": [text]}),
    "institution": ("dc:publisher", lambda text: {"@set": [text]}),
    "description": ("dc:description", _alternatives),
}  # the license follows, see `_license`


@dataclass(frozen=True)
class GlbOptions:
    """Options of a GLB: format of its pictures, storage of its mesh."""

    images: Kind = "png"
    geometry: Geometry = "float"
    origin: Floats | None = None  # (3,) camera frame; by default the middle of the mesh


def encode(
    asset: Asset,
    name: str,
    options: GlbOptions = GlbOptions(),
    provenance: Mapping[str, str] | None = None,
    encoder: TextureEncoder | None = None,
) -> bytes:
    """Encode an asset as a GLB with embedded textures; the same asset gives the same bytes.

    `name` is that of scene, node, mesh and material; `provenance` goes into the XMP packet (KHR_xmp_json_ld); an
    `encoder` that is shared by the files of an export encodes no texture twice.

    Raises SettingError: there is no encoder for this kind of images or geometry.
    """
    blob, images, facts = Blob(), options.images, provenance or {}
    origin = center(asset.mesh.vertices) if options.origin is None else options.origin
    primitive, transform = glb_geometry.add(blob, asset.mesh, origin, options.geometry)
    embedded = textures(asset)
    pictures = [
        {"name": f"{name}_{key}", "bufferView": blob.view(data), "mimeType": encoders.MIME[images]}
        for key, data in (encoder or TextureEncoder()).all(embedded, images).items()
    ]
    used = ["KHR_materials_specular", "KHR_materials_ior", "KHR_xmp_json_ld"]
    extension = _IMAGE_EXTENSION.get(images)
    required = [*([extension] if extension else []), *glb_geometry.EXTENSIONS[options.geometry]]
    document = {
        "asset": {
            "version": "2.0",
            "generator": f"polcap {__version__}",
            **({"copyright": facts["rights"]} if "rights" in facts else {}),
            "extras": _extras(asset, origin) | {"textures": {f"{name}_{k}": embedded[k].meaning for k in embedded}},
            "extensions": {"KHR_xmp_json_ld": {"packet": 0}},
        },
        "extensionsUsed": used + required,
        **({"extensionsRequired": required} if required else {}),
        "extensions": {"KHR_xmp_json_ld": {"packets": [_packet(name, facts)]}},
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, **transform}],
        "meshes": [{"name": name, "primitives": [{**primitive, "material": 0}]}],
        "materials": [_material(asset, name)],
        "textures": [
            {"sampler": 0, "extensions": {extension: {"source": k}}} if extension else {"sampler": 0, "source": k}
            for k in range(len(pictures))
        ],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": pictures,
        "accessors": blob.accessors,
        "bufferViews": blob.views,
        "buffers": [{"byteLength": len(blob.data)}],
    }
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=True).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(blob.data)  # header, and two chunks with headers
    head = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON")
    return b"".join([head, text, struct.pack("<I4s", len(blob.data), b"BIN\0"), blob.data])


def textures(asset: Asset) -> dict[str, Texture]:
    """The textures that a GLB embeds, by name suffix, in the order of the glTF material."""
    return {
        "basecolor": texture_set.base_color(asset),
        "orm": texture_set.occlusion_roughness_metallic(asset),
        "normal": texture_set.normal(asset),
        "specular": texture_set.relative_specular(asset),
    }


def _extras(asset: Asset, origin: Floats) -> dict[str, Any]:
    """Facts of the mesh that glTF has no keys for; `origin` (3,) is the GLB's origin in the mesh's frame."""
    mesh = asset.mesh
    return {
        "unit": "metre" if mesh.metric else "relative",
        "albedo": maps_folder.albedo_scale(asset.albedo_sigma),
        f"origin_in_{mesh.frame}": origin.tolist(),
        "turned_deg": asset.turned_deg,
        "pieces": mesh.pieces,
        "cuts": mesh.cuts,
        "cut_px": mesh.cut_px,
        "raggedness": mesh.raggedness,
    }


def _material(asset: Asset, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "doubleSided": is_open(asset.mesh),
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "normalTexture": {"index": 2},
        **({"occlusionTexture": {"index": 1}} if asset.has_occlusion else {}),
        "extensions": {
            "KHR_materials_specular": {
                "specularColorFactor": list(asset.specular_factor),
                "specularColorTexture": {"index": 3},
            },
            "KHR_materials_ior": {"ior": asset.ior},
        },
    }


def _packet(name: str, provenance: Mapping[str, str]) -> dict[str, Any]:
    """Catalog entry and provenance in terms of Dublin Core, XMP and polcap, as JSON-LD."""
    stated = {"title": name, **provenance}
    return {
        "@context": _CONTEXT,
        "@id": "",
        **{term: write(stated[key]) for key, (term, write) in _CATALOG.items() if key in stated},
        **(_license(stated["license"]) if "license" in stated else {}),
        "dc:format": "model/gltf-binary",
        "xmp:CreatorTool": f"polcap {__version__}",
        **{f"polcap:{key}": value for key, value in provenance.items() if key not in (*_CATALOG, "license")},
    }


def _license(text: str) -> dict[str, Any]:
    """The license in XMP: WebStatement takes an address only, UsageTerms any text."""
    if text.startswith(("http://", "https://")):
        return {"xmpRights:WebStatement": addresses.of_web(text)}
    return {"xmpRights:UsageTerms": _alternatives(text)}


def center(vertices: Floats) -> Floats:
    """Middle (3,) of the bounding box of vertices (V, 3): the asset's origin.

    Subtracting it from float32 vertices loses nothing: they lie on a grid (`surface.triangles.to_float32`).
    """
    return np.asarray((vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2)


def is_open(mesh: Mesh) -> bool:
    """Whether a mesh has a border: an edge that only one triangle has, so that its back can be seen.

    Vertices at one position count as one: a texture atlas repeats those on the borders of its charts.
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    start = place.reshape(-1)[mesh.faces].astype(np.int64)
    end = np.roll(start, -1, axis=1)
    edge = np.minimum(start, end) << 32 | np.maximum(start, end)  # one number for both directions
    _, triangles = np.unique(edge, return_counts=True)
    return bool((triangles == 1).any())
