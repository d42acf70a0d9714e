"""The mesh preview has few vertices, all on the surface."""

import numpy as np

from polcap.report import mesh_preview
from tests import surfaces


def test_mesh_of_a_page_has_few_vertices_where_the_surface_is() -> None:
    mesh = surfaces.mesh(surfaces.maps())
    vertices, uv, faces = mesh_preview.thinned(mesh, 600)
    assert 200 < len(vertices) <= 900 and faces.max() < len(vertices) and len(uv) == len(vertices)
    radius = np.linalg.norm(vertices - mesh.vertices.mean(0), axis=1)
    assert radius.max() <= np.linalg.norm(mesh.vertices - mesh.vertices.mean(0), axis=1).max()
    along, across = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    normals = np.cross(along, across)
    assert (normals[:, 2] > 0).mean() > 0.99  # still seen from the camera
