"""Closed meshes stay closed after programs have joined vertices at one place."""

import numpy as np
from trimesh.creation import box

from polcap.fusion.closed_mesh import is_closed, solid
from polcap.fusion.values import ClosedMesh


def test_bodies_that_touch_along_an_edge_are_closed_after_their_vertices_are_joined():
    one, other, bridge = box(extents=(1, 1, 1)), box(extents=(1, 1, 1)), box(extents=(2, 2, 1))
    other.apply_translation((1, 1, 0))  # touches the first along an edge
    bridge.apply_translation((0.5, 0.5, 1))
    body = bridge.union([one, other], engine="manifold")
    mesh = solid(ClosedMesh(np.asarray(body.vertices), np.asarray(body.faces, np.int32)))
    _, place = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True)
    joined = ClosedMesh(mesh.vertices, place.reshape(-1)[mesh.faces].astype(np.int32))
    assert is_closed(joined)
