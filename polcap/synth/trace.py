"""Intersection of rays with a shape: sphere tracing of distance fields, Embree for meshes.

References
----------
Hart, Sphere tracing, The Visual Computer 1996.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.errors import InputError
from polcap.formats import scene_files
from polcap.image_values import Bools, Floats, Indices
from polcap.optics.mesh_tracer import Tracer, face_camera, smooth
from polcap.synth.distance_fields import Model, Shape

Vector = tuple[float, float, float]
_TOLERANCE = 1e-6  # m, distance at which a ray has arrived
_STEPS = 300  # most steps of a ray
_GRAZING = 1e-4  # m, the same at the last step, for rays along the surface
LIFT = 5e-4  # m above the surface, where a shadow ray starts


@dataclass(frozen=True)
class Hits:
    """Intersections of rays with a shape, sorted by the ray's index."""

    index: Indices  # (N,) of the ray
    distance: Floats  # (N,) along the ray, m
    point: Floats  # (N, 3) camera frame, m
    local: Floats  # (N, 3) shape's own frame, m
    normal: Floats  # (N, 3) camera frame, unit
    face: Indices  # (N,) of a mesh; −1 otherwise
    weight: Floats  # (N, 3) of the face's corners

    def take(self, which: Indices) -> "Hits":
        return Hits(*(value[which] for value in vars(self).values()))


@lru_cache(maxsize=2)
def model_tracer(model: Model) -> Tracer:
    """Tracer of a model's mesh, centered and scaled to fill its sphere."""
    vertices, faces = scene_files.read_mesh(Path(model.file))
    used = vertices[np.unique(faces)]
    vertices = vertices - (used.min(axis=0) + used.max(axis=0)) / 2
    largest = np.linalg.norm(vertices[np.unique(faces)], axis=1).max()
    if not largest > 0:
        raise InputError(f"{model.file} has no extent; give a mesh that is not one point")
    return Tracer(smooth(vertices * (model.radius / largest), faces))


def trace(shape: Shape | Model, position: Vector, turn: Rotation, v: Floats, start: Floats | None = None) -> Hits:
    """First intersections of rays from the lens along −v (P, 3) with a shape turned by `turn` at `position` [m].

    The search begins at the distance `start` (P,) [m], in front of the surface; infinite: the ray misses.
    """
    to_middle = -(v @ np.array(position))
    near = to_middle**2 > np.dot(position, position) - shape.radius**2  # of the rays, to the shape's sphere
    if start is not None:
        near &= np.isfinite(start)
    candidates = np.flatnonzero(near)
    direction = turn.inv().apply(-v[candidates])
    origin = turn.inv().apply(-np.array(position))
    if isinstance(shape, Model):
        met = model_tracer(shape).meet(np.broadcast_to(origin, direction.shape), direction)
        at = candidates[met.index]
        point = turn.apply(met.position) + position
        normal = face_camera(turn.apply(met.normal), v[at])
        return Hits(at, np.linalg.norm(point, axis=1), point, met.position, normal, met.face, met.weight)
    first = 0.0 if start is None else start[candidates]
    index, distance = _march(shape, np.broadcast_to(origin, direction.shape), direction, first)
    local = origin + direction[index] * distance[:, None]
    at = candidates[index]
    point, normal = -v[at] * distance[:, None], turn.apply(gradient(shape, local))
    return Hits(at, distance, point, local, normal, np.full(len(at), -1), np.zeros((len(at), 3)))


def in_shadow(shape: Shape | Model, position: Vector, turn: Rotation, point: Floats, light: Vector) -> Bools:
    """True for points (N, 3) off the shape [m, camera frame] that it hides from a light outside it."""
    origin, source = (turn.inv().apply(np.array(at) - np.array(position)) for at in (point, light))
    if isinstance(shape, Model):
        return model_tracer(shape).hidden(origin, source)
    direction = source - origin
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    out = np.zeros(len(origin), bool)
    out[_march(shape, origin, direction, 0.0)[0]] = True
    return out


def _march(shape: Shape, origin: Floats, direction: Floats, start: Floats | float) -> tuple[Indices, Floats]:
    """Sphere tracing: indices of the rays (P, 3) that hit the shape, in order, and their lengths [m].

    Rays are searched from the length `start` [m] on: one for all, or (P,).
    """
    nearest = -np.einsum("pi,pi->p", origin, direction)  # length (P,) to the ray's point nearest to the shape's origin
    gap2 = np.einsum("pi,pi->p", origin, origin) - nearest**2  # squared distance of the ray from the shape's origin
    half = np.sqrt(np.maximum(shape.radius**2 - gap2, 0.0))  # half the ray's length in the shape's sphere
    alive = np.flatnonzero((half > 0) & (nearest + half > 0))
    travelled = np.maximum(nearest - half, start)[alive]
    end = (nearest + half)[alive]
    arrived_index, arrived_at = [alive[:0]], [travelled[:0]]
    for steps_left in reversed(range(_STEPS)):
        step = shape.distance(origin[alive] + direction[alive] * travelled[:, None])
        travelled = travelled + step
        arrived = np.abs(step) < (_TOLERANCE if steps_left else _GRAZING)
        arrived_index.append(alive[arrived])
        arrived_at.append(travelled[arrived])
        moving = ~arrived & (travelled < end)
        alive, travelled, end = alive[moving], travelled[moving], end[moving]
        if not len(alive):
            break
    index = np.concatenate(arrived_index)
    order = np.argsort(index)
    return index[order], np.concatenate(arrived_at)[order]


def gradient(shape: Shape, p: Floats) -> Floats:
    """Unit normals (N, 3) of a distance field by central differences."""
    steps = 1e-4 * np.eye(3)  # m
    slope = np.stack([shape.distance(p + step) - shape.distance(p - step) for step in steps], axis=-1)
    return np.asarray(slope / np.linalg.norm(slope, axis=-1, keepdims=True))
