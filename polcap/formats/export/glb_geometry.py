"""Stores a mesh in a GLB: as floats, as integers (KHR_mesh_quantization) or compressed by Draco.

| geometry | bytes per vertex | position, normal, tangent, texture coordinate |
| --- | --- | --- |
| float | 48 | 32-bit floats |
| quantized | 24 | 16, 16, 8, 16 bits |
| draco | about 4, with the triangles | 14, 12 (octahedral), 8, 14 bits, entropy coded |

References
----------
Khronos, KHR_mesh_quantization; KHR_draco_mesh_compression; Google, Draco bitstream specification.
"""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.errors import StorageError, package_for
from polcap.image_values import Floats
from polcap.mesh_values import Mesh

Geometry = Literal["float", "quantized", "draco"]
EXTENSIONS: Mapping[Geometry, tuple[str, ...]] = {
    "float": (),
    "quantized": ("KHR_mesh_quantization",),
    "draco": ("KHR_draco_mesh_compression", "KHR_mesh_quantization"),  # the latter for tangents of 8 bits
}
_COMPONENT = {"int8": 5120, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}  # accessor.componentType
_ARRAY, _ELEMENTS = 34962, 34963  # bufferView.target
_DRACO_BITS = {"quantization_bits": 14, "normal_quantization_bits": 12, "tex_coord_quantization_bits": 14}
_DRACO_LEVEL = 7  # 0 fast … 10 small
_DRACO_ATTRIBUTES = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 3, "TANGENT": 4}  # Draco's types of attributes
_DRACO_UINT8, _DRACO_INT8 = 2, 1  # Draco's data types


class Blob:
    """The binary chunk of a GLB with its views and accessors; each part starts at a multiple of four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def attribute(self, array: NDArray[Any], *, bounds: bool = False) -> int:
        """Add a vertex attribute (V, C), its rows padded to a multiple of four bytes; integers are normalized."""
        size = array.dtype.itemsize * array.shape[1]
        pad = -size % 4
        rows = np.pad(array, ((0, 0), (0, pad // array.dtype.itemsize)))
        stride = {"byteStride": size + pad} if pad else {}
        return self.accessor(array, self.view(rows.tobytes(), target=_ARRAY, **stride), bounds=bounds)

    def indices(self, faces: NDArray[np.int32], vertices: int) -> int:
        """Add the corners of triangles (F, 3), in 16 bits where these suffice."""
        numbers = faces.reshape(-1, 1).astype(np.uint16 if vertices <= 65535 else np.uint32)  # 65535 is reserved
        return self.accessor(numbers, self.view(numbers.tobytes(), target=_ELEMENTS))

    def accessor(self, array: NDArray[Any], view: int | None, *, bounds: bool = False) -> int:
        """Add an accessor, which describes an array (N, C) to readers; returns its index.

        The data are in the buffer view `view`; None: in an extension. `bounds` adds the least and greatest values.
        """
        entry: dict[str, Any] = {} if view is None else {"bufferView": view}
        entry |= {
            "componentType": _COMPONENT[array.dtype.name],
            "count": len(array),
            "type": "SCALAR" if array.shape[1] == 1 else f"VEC{array.shape[1]}",
        }
        if array.shape[1] > 1 and array.dtype != np.float32:
            entry["normalized"] = True
        if bounds:
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def view(self, data: bytes, **fields: int) -> int:
        """Add bytes to the binary chunk of a GLB as a buffer view; returns the view's index."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields})
        self.data += data
        self.data += bytes(-len(self.data) % 4)
        return len(self.views) - 1


def require(geometry: Geometry) -> None:
    """Raise a SettingError where `geometry` needs DracoPy and it is not installed."""
    if geometry == "draco":
        with package_for("--geometry draco", "DracoPy", "draco", ", or choose quantized"):
            import DracoPy  # noqa: F401


def add(blob: Blob, mesh: Mesh, origin: Floats, geometry: Geometry) -> tuple[dict[str, Any], dict[str, Any]]:
    """Add a mesh to a GLB with its origin at `origin` (3,); returns primitive and transform. Raises SettingError."""
    points = (mesh.vertices - origin).astype(np.float32)
    if geometry == "draco":
        return _draco(blob, mesh, points), {}
    if geometry == "float":
        arrays = {"POSITION": points, "NORMAL": mesh.normals, "TANGENT": mesh.tangents, "TEXCOORD_0": mesh.uv}
        transform: dict[str, Any] = {}
    else:
        low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())  # one scale, so that normals stay
        arrays = {
            "POSITION": _integers((points - low) / extent, "uint16"),
            "NORMAL": _integers(mesh.normals, "int16"),
            "TANGENT": _integers(mesh.tangents, "int8"),
            "TEXCOORD_0": _integers(mesh.uv, "uint16"),
        }
        transform = {"translation": low.tolist(), "scale": [extent] * 3}
    attributes = {name: blob.attribute(array, bounds=name == "POSITION") for name, array in arrays.items()}
    return {"attributes": attributes, "indices": blob.indices(mesh.faces, len(points))}, transform


def _integers(value: Floats, kind: str) -> NDArray[Any]:
    """Convert values -1…1 or 0…1 to integers relative to their type's largest value, as glTF normalizes them."""
    top = np.iinfo(kind).max
    return np.rint(np.clip(value, -1.0 if np.iinfo(kind).min else 0.0, 1.0) * top).astype(kind)


def _draco(blob: Blob, mesh: Mesh, points: Floats) -> dict[str, Any]:
    """Compress a mesh with Draco; returns the glTF primitive, whose accessors describe the decoded arrays."""
    require("draco")
    import DracoPy

    data = DracoPy.encode(
        points,
        np.ascontiguousarray(mesh.faces, dtype=np.uint32),
        compression_level=_DRACO_LEVEL,
        tex_coord=mesh.uv.astype(np.float64),
        normals=mesh.normals.astype(np.float64),
        generic_attributes={0: _integers(mesh.tangents, "int8").view(np.uint8)},
        **_DRACO_BITS,
    )
    decoded = DracoPy.decode(data)  # Draco may drop vertices
    count = len(decoded.points)
    arrays: dict[str, Any] = {  # only types, shapes and bounds are used: the data are in the extension
        "POSITION": decoded.points.astype(np.float32),
        "NORMAL": np.empty((count, 3), np.float32),
        "TANGENT": np.empty((count, 4), np.int8),
        "TEXCOORD_0": np.empty((count, 2), np.float32),
    }
    by_type = {attribute["attribute_type"]: attribute["unique_id"] for attribute in decoded.attributes}
    identifiers = {name: by_type[kind] for name, kind in _DRACO_ATTRIBUTES.items()}
    view = blob.view(_with_signed_tangents(data, identifiers["TANGENT"]))
    return {
        "attributes": {name: blob.accessor(one, None, bounds=name == "POSITION") for name, one in arrays.items()},
        "indices": blob.accessor(np.empty((decoded.faces.size, 1), np.uint32), None),
        "extensions": {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": identifiers}},
    }


def _with_signed_tangents(data: bytes, identifier: int) -> bytes:
    """The Draco stream with its attribute of four unsigned bytes declared as signed, which DracoPy cannot write.

    The stream declares an attribute by type, data type, number of components, normalized and identifier. The values
    follow as integers modulo 256, so nothing else changes.
    """
    generic = _DRACO_ATTRIBUTES["TANGENT"]
    unsigned = bytes([generic, _DRACO_UINT8, 4, 0, identifier])
    if data.count(unsigned) != 1:
        raise StorageError("this DracoPy writes attributes in an unknown way; choose --geometry quantized")
    return data.replace(unsigned, bytes([generic, _DRACO_INT8, 4, 0, identifier]))
