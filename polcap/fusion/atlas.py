"""Texture atlas of a closed mesh: charts without overlap, and the surface point of each texel.

A chart is a piece of the surface that lies flat in the texture. The package uvunwrap cuts and packs them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.errors import ObjectError, SettingError, package_for
from polcap.fusion.closed_mesh import decimate
from polcap.fusion.values import ClosedMesh, FusionView
from polcap.image_values import Bools, Floats
from polcap.mesh_values import Mesh
from polcap.optics import frames
from polcap.optics.mesh_tracer import Tracer, Triangles
from polcap.optics.texture_rasterizer import rasterize
from polcap.optics.vertex_frames import area_vectors, vertex_normals, vertex_tangents
from polcap.stages import stage

_FILLED = 0.4  # share of the texture that charts cover, about; uvunwrap reaches 0.4 to 0.63
_TRIANGLE = 4  # map pixels to a triangle of the mesh; docs/benchmarks/fusion-choices.md
_FEWEST = 2000  # triangles of the mesh
_SHARES = (1.0, 0.9, 0.8)  # of the triangles, tried in turn until the mesh can be charted
_SIDES = (512, 4096)  # px, least and greatest side of a texture whose size is not set


class AtlasSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `atlas` of the fusion."""

    size: Annotated[int, Meta(ge=0, le=8192, description="side of the textures; 0: a texel is one map pixel [px]")] = 0
    margin: Annotated[
        int, Meta(ge=1, le=32, description="gap between UV charts, filled with their border colors [px]")
    ] = 6


@dataclass(frozen=True)
class Atlas:
    """A closed mesh with texture coordinates, and the surface points of the N texels that it covers."""

    mesh: Mesh  # board frame; vertices on the charts' borders are repeated
    covered: Bools  # (S, S) texels with a surface point
    position: Floats  # (N, 3) m, board frame
    normal: Floats  # (N, 3) unit, of the mesh
    margin: int  # px between charts

    @property
    def texel(self) -> float:
        """Side of a texel on the surface, m."""
        return float(np.sqrt(_area(self.mesh) / max(len(self.position), 1)))

    def tracer(self) -> Tracer:
        """The mesh prepared for ray tracing."""
        return Tracer(Triangles(self.mesh.vertices, self.mesh.faces, self.mesh.normals[self.mesh.faces]))


@stage(version=3)
def unwrap(mesh: ClosedMesh, views: tuple[FusionView, ...], settings: AtlasSettings) -> Atlas:
    """Cut a closed mesh into charts, and pack them into a square texture.

    The mesh is reduced to a triangle for four pixels of the views' maps: with smaller triangles, charts would have only
    a few texels. Without a set size, the side is the least power of two whose texels are no larger than these pixels.

    Raises SettingError, ObjectError: as `chart`, for the mesh and for coarser ones.
    """
    pixel = _pixel_m(mesh, views)
    count = max(min(int(_area(mesh) / (_TRIANGLE * pixel**2)), len(mesh.faces)), _FEWEST)
    return chart_reduced(mesh, count, lambda coarse: _chart_sized(coarse, pixel, settings, views[0].metric))


def chart_reduced(mesh: ClosedMesh, count: int, make: Callable[[ClosedMesh], Atlas]) -> Atlas:
    """The atlas that `make` returns for a mesh with about `count` triangles, or with fewer if it fails on these.

    Raises ObjectError: it fails on all, or these are too few triangles to enclose a body.
    """
    for share in _SHARES:
        coarse = decimate(mesh, int(share * count))
        try:
            return make(coarse)
        except ObjectError as error:
            failure = error
    raise failure


def _chart_sized(mesh: ClosedMesh, pixel: float, settings: AtlasSettings, metric: bool) -> Atlas:
    """The atlas in the size of the settings, or in the first size with texels of at most `pixel` [m]."""
    least = 2 ** np.ceil(np.log2(np.sqrt(_area(mesh) / _FILLED) / pixel))
    side = settings.size or int(np.clip(least, *_SIDES))
    found = chart(mesh, side, settings.margin, metric)
    while not settings.size and found.texel > pixel and side < _SIDES[1]:  # the charts' margins need room, too
        side *= 2
        found = chart(mesh, side, settings.margin, metric)
    return found


def chart(mesh: ClosedMesh, side: int, margin: int, metric: bool = True) -> Atlas:
    """Cut a closed mesh into charts, and pack them into a texture of `side` px, with `margin` px between them.

    `metric`: the mesh is in metres.

    Raises SettingError: the package uvunwrap is missing, or the charts do not fit into a texture of this size.
    ObjectError: uvunwrap fails on this mesh.
    """
    uv, vertex, faces = _cut_charts(mesh, side, margin)
    normals = vertex_normals(mesh.vertices.astype(np.float64), mesh.faces)[vertex]
    vertices = mesh.vertices[vertex].astype(np.float64)
    unwrapped = Mesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        tangents=vertex_tangents(vertices, uv, faces, normals).astype(np.float32),
        faces=faces,
        metric=metric,
        frame="board",
    )
    return of_mesh(unwrapped, side, margin)


def of_mesh(mesh: Mesh, side: int, margin: int) -> Atlas:
    """The atlas of a mesh that has texture coordinates, with `side` px."""
    points = rasterize(mesh.uv, mesh.faces, side, side)
    normal = frames.unit(points.interpolate(mesh.normals))
    return Atlas(mesh, points.covered, points.interpolate(mesh.vertices), normal, margin)


def _cut_charts(mesh: ClosedMesh, side: int, margin: int) -> tuple[Floats, NDArray[np.int64], NDArray[np.int32]]:
    """Vertices of the charts: texture coordinates (W, 2), v down, and indices (W,) in the mesh; their faces (F, 3)."""
    with package_for("a texture atlas", "uvunwrap", "fusion"):
        import uvunwrap
    surface = uvunwrap.Mesh(mesh.vertices.astype(np.float32).ravel().tolist(), mesh.faces.ravel().tolist())
    try:
        packed = uvunwrap.generate([surface], page_size=side, padding=margin)
    except BaseException as error:
        # its solver (faer 0.22) fails on some charts at random, with a panic of Rust that is no Exception
        if not isinstance(error, uvunwrap.UnwrapError) and type(error).__name__ != "PanicException":
            raise
        raise ObjectError(f"the mesh of {len(mesh.faces)} triangles has no texture atlas ({error})") from error
    if packed.page_count != 1:
        raise SettingError(f"the charts do not fit into {side} px; raise fusion.atlas.size")
    found = packed.meshes[0]
    uv = np.asarray(found.uv, np.float64).reshape(-1, 2) * [packed.width / side, packed.height / side]
    faces = np.asarray(found.indices, np.int32).reshape(-1, 3)
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1), np.asarray(found.xref, np.int64), faces


def _pixel_m(mesh: ClosedMesh, views: tuple[FusionView, ...]) -> float:
    """Side of a pixel of the views' maps at the object [m]."""
    middle = mesh.vertices.mean(axis=0)
    return float(
        np.median([-(one.pose.rotation @ middle + one.pose.translation)[2] / one.camera.focal for one in views])
    )


def _area(mesh: ClosedMesh | Mesh) -> float:
    """Area of a mesh's surface [m²]."""
    return float(np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=-1).sum() / 2)
