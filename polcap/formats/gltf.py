"""In: an Asset. Out: one binary glTF 2.0 file (GLB), written by hand.

The camera frame is already glTF's: right-handed, y up, the viewer on +z, metres. The object is moved
to the origin; `asset.extras` says from where.

References
----------
Khronos, glTF 2.0; KHR_materials_specular; KHR_materials_ior.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from polcap import __version__
from polcap.formats import atomic, png
from polcap.images import Asset, Floats

_FLOAT, _UINT32 = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963  # bufferView.target
_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071


def write(path: Path, asset: Asset, name: str) -> None:
    """Write a GLB with embedded PNG textures; the same asset gives the same bytes.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    with atomic.path(path) as temporary:
        temporary.write_bytes(encode(asset, name))


def encode(asset: Asset, name: str) -> bytes:
    """The bytes of the GLB."""
    mesh = asset.mesh
    middle = center(mesh.vertices)
    blob = _Blob()
    position = blob.accessor((mesh.vertices - middle).astype(np.float32), "VEC3", bounds=True)
    normal = blob.accessor(mesh.normals, "VEC3")
    tangent = blob.accessor(mesh.tangents, "VEC4")
    uv = blob.accessor(mesh.uv, "VEC2")
    indices = blob.accessor(mesh.faces.reshape(-1).astype(np.uint32), "SCALAR")
    pictures = {
        "basecolor": asset.base_color,
        "orm": asset.occlusion_roughness_metallic,
        "normal": asset.normal,
        "specular": asset.specular_color,
    }
    images = [blob.image(f"{name}_{key}", png.encode(value)) for key, value in pictures.items()]
    material = {
        "name": name,
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
    document = {
        "asset": {
            "version": "2.0",
            "generator": f"polcap {__version__}",
            "extras": {
                "unit": "metre" if mesh.metric else "relative",
                "origin_in_camera": [float(x) for x in middle],
            },
        },
        "extensionsUsed": ["KHR_materials_specular", "KHR_materials_ior"],
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [
            {
                "name": name,
                "primitives": [
                    {
                        "attributes": {
                            "POSITION": position,
                            "NORMAL": normal,
                            "TANGENT": tangent,
                            "TEXCOORD_0": uv,
                        },
                        "indices": indices,
                        "material": 0,
                    }
                ],
            }
        ],
        "materials": [material],
        "textures": [{"sampler": 0, "source": k} for k in range(len(images))],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": images,
        "accessors": blob.accessors,
        "bufferViews": blob.views,
        "buffers": [{"byteLength": len(blob.data)}],
    }
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=True).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(blob.data)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, size),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(blob.data), b"BIN\0"),
            bytes(blob.data),
        ]
    )


def center(vertices: Floats) -> Floats:
    """Middle of the bounding box (3,): the asset's origin."""
    return np.asarray((vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2)


class _Blob:
    """The binary chunk as it grows, each part on a multiple of four bytes."""

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
            entry["min"] = [float(x) for x in array.min(axis=0)]
            entry["max"] = [float(x) for x in array.max(axis=0)]
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def image(self, name: str, data: bytes) -> dict[str, Any]:
        return {"name": name, "bufferView": self._view(data), "mimeType": "image/png"}

    def _view(self, data: bytes, **fields: int) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields})
        self.data += data
        self.data += bytes(-len(self.data) % 4)
        return len(self.views) - 1
