"""Mesh preview of the report page: few vertices, stored with 16 bits and compressed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.formats import html
from polcap.images import Floats, Mesh

_MOST_VERTICES = 60_000  # 0.7 MB of the page
_STEPS = 65535


def packed(mesh: Mesh) -> dict[str, Any]:
    """Base64 texts of positions (V, 3), texture coordinates (V, 2) and differences between face indices.

    Positions are shares of the box `low`, `extent`; a share of 1 is stored as 65535.
    """
    vertices, uv, faces = thinned(mesh, _MOST_VERTICES)
    low = vertices.min(axis=0)
    extent = np.maximum(vertices.max(axis=0) - low, 1e-9)
    flat = faces.astype(np.int32).ravel()
    return {
        "position": html.packed(_sixteen_bits((vertices - low) / extent)),
        "uv": html.packed(_sixteen_bits(uv)),
        "faces": html.packed(np.diff(flat, prepend=np.int32(0))),
        "low": [float(edge) for edge in low],
        "extent": [float(edge) for edge in extent],
    }


def thinned(mesh: Mesh, most: int) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Vertices (V, 3), texture coordinates (V, 2) and faces (F, 3), reduced to about `most` vertices.

    Connected vertices in the same cell of a grid over the texture are replaced by their mean. Two surfaces that
    overlap in the picture are not connected, so they stay separate.
    """
    from scipy.sparse import coo_array, csgraph  # importing scipy takes 0.3 s

    count = len(mesh.vertices)
    if count <= most:
        return mesh.vertices, mesh.uv, mesh.faces
    side = float(np.sqrt(_covered(mesh.uv) / most))  # of a cell [texture coordinates]
    column, row = np.floor(mesh.uv / side).astype(np.int64).T
    cell = row * (int(1 / side) + 2) + column
    edges = np.concatenate([mesh.faces[:, pair] for pair in ((0, 1), (1, 2), (2, 0))])
    edges = edges[cell[edges[:, 0]] == cell[edges[:, 1]]]
    links = coo_array((np.ones(len(edges), np.int8), edges.T), shape=(count, count))
    groups, label = csgraph.connected_components(links, directed=False)
    share = 1 / np.bincount(label, minlength=groups)

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(label, column, groups) * share for column in values.T], axis=-1)

    faces = label[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return mean(mesh.vertices), mean(mesh.uv), faces[whole].astype(np.int32)


def _covered(uv: Floats) -> float:
    """Share of the texture that has vertices, counted in 64 × 64 cells."""
    cells = np.unique(np.floor(np.clip(uv, 0, 1 - 1e-6) * 64).astype(int) @ [64, 1])
    return len(cells) / 64**2


def _sixteen_bits(share: Floats) -> NDArray[np.uint16]:
    return np.asarray(np.rint(np.clip(share, 0, 1) * _STEPS), np.uint16)
