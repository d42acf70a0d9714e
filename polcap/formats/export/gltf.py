"""Writes an asset as binary glTF 2.0 (GLB).

The camera frame is that of glTF: right-handed, y up, the viewer on +z, metres. The object is moved
to the origin; its place in the camera frame is in `asset.extras`. The provenance is in an XMP packet.

References
----------
Khronos, glTF 2.0; KHR_materials_specular; KHR_materials_ior; KHR_xmp_json_ld; EXT_texture_webp;
KHR_texture_basisu.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap import __version__
from polcap.formats import atomic
from polcap.formats.export import encoders, texture_set
from polcap.formats.export.encoders import Kind, TextureEncoder
from polcap.formats.export.texture_set import Texture
from polcap.formats.maps import maps_folder
from polcap.images import Asset, Floats, Mesh

_FLOAT, _UINT32 = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963  # bufferView.target
_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071
_IMAGE_EXTENSION: dict[Kind, str] = {"webp": "EXT_texture_webp", "ktx2": "KHR_texture_basisu"}
_CONTEXT = {
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "dc": "http://purl.org/dc/elements/1.1/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "polcap": "urn:polcap:provenance:1",
}


def write(
    path: Path,
    asset: Asset,
    name: str,
    images: Kind = "png",
    provenance: Mapping[str, str] | None = None,
    encoder: TextureEncoder | None = None,
) -> None:
    """Write a GLB with embedded textures; the same asset gives the same bytes.

    `name` is that of scene, node, mesh and material; `provenance` goes into the XMP packet (KHR_xmp_json_ld); an
    `encoder` that is shared by the files of an export encodes no texture twice.

    Raises SettingError: there is no encoder for this kind of images.
    Raises StorageError: the file cannot be written.
    """
    atomic.write(path, encode(asset, name, images, provenance, encoder))


def encode(
    asset: Asset,
    name: str,
    images: Kind = "png",
    provenance: Mapping[str, str] | None = None,
    encoder: TextureEncoder | None = None,
) -> bytes:
    """The bytes of the GLB that `write` writes."""
    blob = _Blob()
    primitive = _primitive(asset.mesh, blob)
    held = textures(asset)
    pictures = [
        blob.image(f"{name}_{key}", data, encoders.MIME[images])
        for key, data in (encoder or TextureEncoder()).all(held, images).items()
    ]
    used = ["KHR_materials_specular", "KHR_materials_ior", "KHR_xmp_json_ld"]
    required = [_IMAGE_EXTENSION[images]] if images in _IMAGE_EXTENSION else []
    document = {
        "asset": {
            "version": "2.0",
            "generator": f"polcap {__version__}",
            "extras": {
                "unit": "metre" if asset.mesh.metric else "relative",
                "albedo": maps_folder.albedo_scale(asset.albedo_sigma),
                "origin_in_camera": center(asset.mesh.vertices).tolist(),
                "pieces": asset.mesh.pieces,
                "cuts": asset.mesh.cuts,
                "cut_px": asset.mesh.cut_px,
                "raggedness": asset.mesh.raggedness,
                "textures": {f"{name}_{key}": texture.meaning for key, texture in held.items()},
            },
            "extensions": {"KHR_xmp_json_ld": {"packet": 0}},
        },
        "extensionsUsed": used + required,
        **({"extensionsRequired": required} if required else {}),
        "extensions": {"KHR_xmp_json_ld": {"packets": [_packet(name, provenance or {})]}},
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [_material(asset, name)],
        "textures": [
            {"sampler": 0, "extensions": {required[0]: {"source": k}}} if required else {"sampler": 0, "source": k}
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
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob.data), len(text), b"JSON")
    return b"".join([head, text, struct.pack("<I4s", len(blob.data), b"BIN\0"), blob.data])


def textures(asset: Asset) -> dict[str, Texture]:
    """The embedded textures, by the end of their names, in the order of the material."""
    return {
        "basecolor": texture_set.base_color(asset),
        "orm": texture_set.packed(asset),
        "normal": texture_set.normal(asset),
        "specular": texture_set.relative_specular(asset),
    }


def _primitive(mesh: Mesh, blob: "_Blob") -> dict[str, Any]:
    return {
        "attributes": {
            "POSITION": blob.accessor((mesh.vertices - center(mesh.vertices)).astype(np.float32), "VEC3", bounds=True),
            "NORMAL": blob.accessor(mesh.normals, "VEC3"),
            "TANGENT": blob.accessor(mesh.tangents, "VEC4"),
            "TEXCOORD_0": blob.accessor(mesh.uv, "VEC2"),
        },
        "indices": blob.accessor(mesh.faces.reshape(-1).astype(np.uint32), "SCALAR"),
        "material": 0,
    }


def _material(asset: Asset, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "doubleSided": is_open(asset.mesh.faces),
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "normalTexture": {"index": 2},
        "extensions": {
            "KHR_materials_specular": {
                "specularColorFactor": list(asset.specular_factor),
                "specularColorTexture": {"index": 3},
            },
            "KHR_materials_ior": {"ior": asset.ior},
        },
    }


def _packet(name: str, provenance: Mapping[str, str]) -> dict[str, Any]:
    """Title and provenance in Dublin Core and polcap's own terms, as JSON-LD."""
    return {
        "@context": _CONTEXT,
        "@id": "",
        "dc:title": {"@type": "rdf:Alt", "rdf:_1": {"@language": "x-default", "@value": name}},
        "dc:format": "model/gltf-binary",
        "xmp:CreatorTool": f"polcap {__version__}",
        **{f"polcap:{key}": value for key, value in provenance.items()},
    }


def center(vertices: Floats) -> Floats:
    """Middle (3,) of the bounding box of vertices (V, 3): the asset's origin.

    Subtracting it from float32 vertices loses nothing: they lie on a grid (`surface.triangles.on_grid`).
    """
    return np.asarray((vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2)


def is_open(faces: NDArray[np.int32]) -> bool:
    """Whether some edge of faces (F, 3) belongs to one triangle only, so that the back of the surface is visible."""
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1)
    _, triangles = np.unique(np.minimum(start, end) << 32 | np.maximum(start, end), return_counts=True)
    return bool((triangles == 1).any())


class _Blob:
    """The binary chunk; each part starts at a multiple of four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def accessor(self, array: Any, kind: str, bounds: bool = False) -> int:
        floating = array.dtype == np.float32
        view = self._view(np.ascontiguousarray(array).tobytes(), target=_ARRAY if floating else _ELEMENTS)
        entry: dict[str, Any] = {
            "bufferView": view,
            "componentType": _FLOAT if floating else _UINT32,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def image(self, name: str, data: bytes, mime: str) -> dict[str, Any]:
        return {"name": name, "bufferView": self._view(data), "mimeType": mime}

    def _view(self, data: bytes, **fields: int) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields})
        self.data += data
        self.data += bytes(-len(self.data) % 4)
        return len(self.views) - 1
