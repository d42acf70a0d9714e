"""Writes the mesh without textures: PLY with a color per vertex, for mesh tools, and STL, for 3-D printers."""

from pathlib import Path

import numpy as np

from polcap.formats import atomic
from polcap.formats.export import gltf
from polcap.image_values import TexturePixels
from polcap.mesh_values import Asset

_MM = 1000  # per m; STL states no unit, and printing programs read mm


def write(path: Path, asset: Asset, comment: str = "") -> None:
    """Write a mesh as PLY or STL, by the suffix of `path`; the origin is that of the GLB.

    PLY has the unit of the GLB, and the lines of `comment`. STL is in mm where the mesh is metric.
    """
    import trimesh

    mesh = asset.mesh
    vertices = mesh.vertices - gltf.center(mesh.vertices)
    if path.suffix == ".stl":
        scaled = vertices * (_MM if mesh.metric else 1)
        content = trimesh.exchange.stl.export_stl(trimesh.Trimesh(scaled, mesh.faces, process=False))
    else:
        colors = {"vertex_normals": mesh.normals, "vertex_colors": _vertex_colors(asset)}
        colored = trimesh.Trimesh(vertices, mesh.faces, process=False, **colors)
        head, end, body = trimesh.exchange.ply.export_ply(colored, vertex_normal=True).partition(b"element")
        content = head + "".join(f"comment {line}\n" for line in comment.splitlines()).encode() + end + body
    atomic.write(path, content)


def _vertex_colors(asset: Asset) -> TexturePixels:
    """Base color of the texture's pixel at each vertex, (V, 3) sRGB of 8 bits."""
    texture = asset.base_color
    side = np.array(texture.shape[1::-1])  # x, y
    x, y = np.clip(asset.mesh.uv * side, 0, side - 1).astype(int).T
    color: TexturePixels = texture[y, x]
    return (color >> 8).astype(np.uint8) if color.dtype == np.uint16 else color
