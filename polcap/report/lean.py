"""In: a mesh. Out: one light enough for a page: 16-bit positions and texture coordinates, packed."""

from typing import Any

import numpy as np

from polcap.formats import html
from polcap.images import Floats, Mesh

_STEPS = 65535


def packed(mesh: Mesh) -> dict[str, Any]:
    """Positions (V, 3) in 1/65535 of their box, texture coordinates (V, 2) likewise, faces as differences."""
    low = mesh.vertices.min(axis=0)
    extent = np.maximum(mesh.vertices.max(axis=0) - low, 1e-9)
    faces = mesh.faces.astype(np.int32).ravel()
    return {
        "position": html.packed(_sixteen_bits((mesh.vertices - low) / extent)),
        "uv": html.packed(_sixteen_bits(mesh.uv)),
        "faces": html.packed(np.diff(faces, prepend=np.int32(0))),
        "low": [float(edge) for edge in low],
        "extent": [float(edge) for edge in extent],
    }


def _sixteen_bits(share: Floats) -> np.ndarray[Any, np.dtype[np.uint16]]:
    return np.rint(np.clip(share, 0, 1) * _STEPS).astype(np.uint16)
