"""Ray tracing of triangle meshes by Embree: intersections, shadows, and G-buffers of a pinhole camera.

Closed meshes that overlap render as their union.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import InputError, package_for
from polcap.image_values import ArrayValue, Bools, Floats, View
from polcap.optics import frames
from polcap.optics.vertex_frames import area_vectors

_LEAST_FACING = 0.01  # least cosine between normal and view; smoothing may turn normals away from the camera


@dataclass(frozen=True, repr=False)
class GBuffer(ArrayValue):
    """Geometry buffer: the surface point at each pixel."""

    normal: Floats  # (H, W, 3) unit, camera frame; 0 outside
    depth: Floats  # (H, W) along the optical axis, growing away from the camera, m; NaN outside
    mask: Bools  # (H, W)
    position: Floats  # (H, W, 3) in the object's own frame, for solid textures; 0 outside
    view: View


@dataclass(frozen=True)
class Triangles:
    """A triangle mesh with a shading normal at every corner."""

    vertices: Floats  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    corner_normals: Floats  # (F, 3, 3) unit, of each face's three corners

    def vertex_normals(self) -> Floats:
        """Means (V, 3) of the normals of the corners at each vertex, unit length."""
        total: Floats = np.zeros(self.vertices.shape)
        np.add.at(total, self.faces, self.corner_normals)
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def smooth(vertices: Floats, faces: NDArray[np.integer], crease: float = 0.75) -> Triangles:
    """Mesh (V, 3), (F, 3) with shading normals, angle-weighted, smooth across edges with an angle below `crease` rad.

    Vertices at the same position count as one, so that seams of a texture atlas stay invisible.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float32)
    index = np.ascontiguousarray(faces, dtype=np.int32)
    grain = max(float(np.ptp(vertices, axis=0).max()), 1e-20) * 1e-6
    _, place = np.unique(np.round(vertices / grain).astype(np.int64), axis=0, return_inverse=True)
    place = place.reshape(-1)[index]  # (F, 3)
    corner = vertices[index]
    flat = frames.unit(area_vectors(vertices, index))
    total = np.zeros((place.max() + 1, 3), dtype=np.float64)
    for k in range(3):
        ahead, back = (frames.unit(corner[:, (k + j) % 3] - corner[:, k]) for j in (1, 2))
        angle = np.arccos(np.clip(np.sum(ahead * back, axis=1), -1, 1))
        for axis in range(3):
            total[:, axis] += np.bincount(place[:, k], weights=angle * flat[:, axis], minlength=len(total))
    flat = flat[:, None, :]
    shared = frames.unit(total)[place]  # (F, 3, 3)
    sharp = np.sum(shared * flat, axis=-1, keepdims=True) < np.cos(crease)
    return Triangles(vertices, index, np.where(sharp, flat, shared).astype(np.float32))


def union(parts: Sequence[Triangles]) -> Triangles:
    """Join several meshes into one."""
    offset = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Triangles(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offset)]).astype(np.int32),
        np.concatenate([p.corner_normals for p in parts]),
    )


def centred(mesh: Triangles) -> Triangles:
    """Mesh moved and scaled: middle at the origin, longest side 1. Raises InputError if it has no extent."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    longest = (high - low).max()
    if not 0 < longest < np.inf:
        raise InputError(f"a mesh's longest side is {longest:g}; give one that has an extent")
    return replace(mesh, vertices=((mesh.vertices - (low + high) / 2) / longest).astype(np.float32))


@dataclass(frozen=True)
class MeshHits:
    """First intersections of rays with a mesh, sorted by the ray's index; coordinates in the mesh's frame."""

    index: NDArray[np.intp]  # (N,) of the ray
    position: Floats  # (N, 3)
    normal: Floats  # (N, 3) unit, interpolated from the corners
    face: NDArray[np.integer]  # (N,)
    weight: Floats  # (N, 3) of the face's corners


class Tracer:
    """A mesh prepared for ray tracing by Embree."""

    def __init__(self, mesh: Triangles) -> None:
        with package_for("tracing of meshes", "embreex", "fusion"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        self.mesh = mesh
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices, mesh.faces)
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self._flat = frames.unit(area_vectors(mesh.vertices.astype(np.float64), mesh.faces))

    def trace(self, rotation: Floats, translation: Floats, view: View, height: int, width: int) -> GBuffer:
        """G-buffer of the mesh with vertices at rotation @ vertex + translation [m, camera frame].

        rotation (3, 3), translation (3,).
        """
        v = frames.rays(view, height, width).reshape(-1, 3)  # surface to camera, camera frame
        origin = np.broadcast_to(-translation @ rotation, v.shape)
        direction = -v @ rotation
        met = self.meet(origin, direction)
        size = (height, width)
        depth = scatter(-(met.position @ rotation.T + translation)[:, 2], met.index, size, np.nan)
        normal = scatter(face_camera(met.normal @ rotation.T, v[met.index]), met.index, size)
        return GBuffer(normal, depth, np.isfinite(depth), scatter(met.position, met.index, size), view)

    def meet(self, origin: Floats, direction: Floats) -> MeshHits:
        """First intersections of rays (P, 3) with the mesh."""
        hit = self._intersect(origin, direction)
        index = np.flatnonzero(hit["primID"] >= 0)
        face = hit["primID"][index]
        b, c = hit["u"][index], hit["v"][index]
        weight = np.stack([1 - b - c, b, c], axis=1)
        position = np.sum(self.mesh.vertices[self.mesh.faces[face]] * weight[..., None], axis=1)
        normal = frames.unit(np.sum(self.mesh.corner_normals[face] * weight[..., None], axis=1))
        return MeshHits(index, position, normal, face, weight)

    def first_hits(self, origin: Floats, direction: Floats) -> tuple[Floats, Floats]:
        """Distances (P,) to the first hits of rays (P, 3), and the triangles' normals (P, 3) there, facing the rays.

        The distance is infinite where a ray hits nothing.
        """
        hit = self._intersect(origin, direction)
        struck = hit["primID"] >= 0
        normal = self._flat[np.where(struck, hit["primID"], 0)]
        normal = np.where(np.sum(normal * direction, axis=1, keepdims=True) > 0, -normal, normal)
        return np.where(struck, hit["tfar"], np.inf), normal

    def hidden(self, origin: Floats, target: Floats) -> Bools:
        """True where the mesh hides points (P, 3) from targets, (P, 3) or (3,)."""
        path = target - origin
        length = np.linalg.norm(path, axis=1)
        ray = (np.ascontiguousarray(a, dtype=np.float32) for a in (origin, path / length[:, None], length))
        return np.asarray(self._scene.run(*ray, query="OCCLUDED") >= 0)

    def _intersect(self, origin: Floats, direction: Floats) -> dict[str, Any]:
        """Embree's answer for rays (P, 3): first triangle `primID`, −1 for none; distance `tfar`; place `u`, `v`."""
        ray = (np.ascontiguousarray(a, dtype=np.float32) for a in (origin, direction))
        found: dict[str, Any] = self._scene.run(*ray, query="INTERSECT", output=True)
        return found


def face_camera(normal: Floats, v: Floats) -> Floats:
    """Turn normals (N, 3) towards the camera, along rays v (N, 3).

    Normals that face away (cosine under −0.3) are flipped. Normals that smoothing turned slightly away are tilted back.
    """
    facing = np.sum(normal * v, axis=-1, keepdims=True)
    normal = np.where(facing < -0.3, -normal, normal)
    facing = np.where(facing < -0.3, -facing, facing)
    return frames.unit(normal + np.maximum(_LEAST_FACING - facing, 0.0) * v)


def scatter(value: Floats, at: NDArray[np.integer], size: tuple[int, ...], empty: float = 0.0) -> Floats:
    """Image (H, W, ·) with values (N, ·) at the flat indices `at` (N,), `empty` elsewhere."""
    out = np.full((size[0] * size[1], *value.shape[1:]), empty, dtype=np.float32)
    out[at] = value
    return out.reshape(*size, *value.shape[1:])
