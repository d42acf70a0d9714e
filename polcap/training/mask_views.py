"""Traced views of objects before a backdrop, without materials, for the pictures of the mask's training.

Lengths are in longest sides of the object; camera frame of `optics/frames.py`, the lens at the origin. The backdrop is
one or two planes: a wall behind the object; a table, and a wall behind; or a cloth on which the object lies.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, View
from polcap.optics import frames
from polcap.synth.mesh_tracer import Tracer, Triangles, centred, union
from polcap.training import random_shapes

Framing = Literal["whole", "small", "cut", "full"]
Backdrop = Literal["wall", "table", "cloth"]
_LIFT = 2e-3  # from a surface to the start of a ray to the flash
_TRIES = 60  # random sides per framing
_MIN_COVER = 0.004  # least share of the picture that the object covers
_FILL: dict[Framing, tuple[float, float]] = {  # extent of the object over that of the picture
    "whole": (0.35, 0.95), "small": (0.15, 0.35), "cut": (0.6, 1.2), "full": (1.3, 2.2),
}  # fmt: skip
_MAX_COVER: dict[Framing, float] = {"whole": 0.8, "small": 0.4, "cut": 0.85, "full": 0.97}


@dataclass(frozen=True)
class ViewKind:
    """Composition of a view."""

    framing: Framing
    backdrop: Backdrop
    flash_offset: tuple[float, float]  # least and greatest distance from lens to flash [object distances]


@dataclass(frozen=True)
class TracedObject:
    """The object in a view: M pixels."""

    inside: NDArray[np.int32]  # (M,) indices into H·W
    normal: Floats  # (M, 3) camera frame
    position: Floats  # (M, 3) object frame
    depth: Floats  # (M,) along the optical axis
    lit: NDArray[np.bool_]  # (M,) the flash reaches it
    turn: Floats  # (3, 3) rotation from the object's frame to the camera's


@dataclass(frozen=True)
class MaskView:
    """A view of H×W pixels."""

    view: View
    size: tuple[int, int]  # H, W
    object: TracedObject
    distance: float  # of the object's center
    flash: Floats  # (3,)
    planes: Floats  # (P, 4) backdrop: unit normal towards the camera, and its product with a point of the plane
    shadow: NDArray[np.bool_]  # (H, W) the object hides the flash from the backdrop

    @property
    def mask(self) -> NDArray[np.bool_]:
        out = np.zeros(self.size, bool)
        out.reshape(-1)[self.object.inside] = True
        return out


def draw_kind(rng: np.random.Generator) -> ViewKind:
    """Draw a composition; difficult ones more often than in photographs."""
    framing: Framing = rng.choice(["whole", "small", "cut", "full"], p=[0.66, 0.12, 0.16, 0.06])
    setting: Backdrop = rng.choice(["wall", "table", "cloth"], p=[0.4, 0.4, 0.2])
    return ViewKind(framing, setting, (0.2, 0.7) if rng.random() < 0.3 else (0.0, 0.15))


def side_by_side(meshes: list[Triangles], rng: np.random.Generator) -> Triangles:
    """Meshes of longest side 1 in one mesh, side by side with small gaps or overlaps."""
    parts, edge = [], 0.0
    for mesh in meshes:
        turned = mesh.vertices @ random_shapes.rotation(rng).T * rng.uniform(0.4, 1.0)
        low = turned.min(axis=0)
        turned = turned - low + [edge, rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)]
        edge = float(turned[:, 0].max()) + rng.uniform(-0.05, 0.3)
        parts.append(Triangles(turned.astype(np.float32), mesh.faces, _corner_normals(turned, mesh.faces)))
    return centred(union(parts))


def _corner_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Smooth normals (F, 3, 3) of the corners of all faces, weighted by area."""
    corner = vertices[faces]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], flat)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)
    return np.asarray(total[faces], dtype=np.float32)


def trace_view(tracer: Tracer, kind: ViewKind, size: tuple[int, int], rng: np.random.Generator) -> MaskView | None:
    """Trace the object from a random side; None if it cannot be framed as asked."""
    for _ in range(_TRIES):
        turn = random_shapes.rotation(rng)
        view, place = _framed(tracer.mesh.vertices @ turn.T, kind.framing, size, rng)
        if place[2] > -0.8:  # not too near the lens
            continue
        buffer = tracer.trace(turn, place, view, *size)
        share = buffer.mask.mean()
        edge = np.concatenate([buffer.mask[[0, -1]].ravel(), buffer.mask[:, [0, -1]].ravel()]).mean()
        if _MIN_COVER < share < _MAX_COVER[kind.framing] and (edge > 0.01) == (kind.framing in ("cut", "full")):
            break
    else:
        return None
    distance = float(np.linalg.norm(place))
    off, way = rng.uniform(*kind.flash_offset) * distance, rng.normal(np.pi / 2, 0.9)
    flash = np.array([off * np.cos(way), off * np.sin(way), 0.0])
    planes = _planes(tracer.mesh.vertices @ turn.T + place, kind.backdrop, rng)
    inside = np.flatnonzero(buffer.mask)
    v = frames.rays(view, *size).reshape(-1, 3)
    source = (flash - place) @ turn
    normal = buffer.normal[buffer.mask]
    point = -v[inside] * (buffer.depth[buffer.mask] / v[inside, 2])[:, None]
    lit = ~tracer.hidden((point + _LIFT * normal - place) @ turn, source)
    behind, _, _ = meet_planes(planes, v)
    behind = np.where(np.isfinite(behind), behind, 1e3)
    outside = np.flatnonzero(~buffer.mask)
    shadow = np.zeros(size, bool)
    shadow.reshape(-1)[outside] = tracer.hidden((-v[outside] * behind[outside, None] - place) @ turn, source)
    traced = TracedObject(
        inside.astype(np.int32), normal.astype(np.float16), buffer.position[buffer.mask].astype(np.float16),
        buffer.depth[buffer.mask], lit, turn,
    )  # fmt: skip
    return MaskView(view, size, traced, distance, flash, planes, shadow)


def meet_planes(planes: Floats, v: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Distance (N,) along rays −v (N, 3) to the nearest plane, infinite for none; its normal (N, 3) and number (N,)."""
    facing = v @ planes[:, :3].T  # (N, P)
    with np.errstate(divide="ignore"):
        distance = np.where(facing > 1e-3, -planes[:, 3] / np.maximum(facing, 1e-3), np.inf)
    distance = np.where(distance > 0, distance, np.inf)
    first = distance.argmin(axis=1)
    return distance[np.arange(len(v)), first], planes[first, :3], first


def _framed(turned: Floats, framing: Framing, size: tuple[int, int], rng: np.random.Generator) -> tuple[View, Floats]:
    """View of a 35–100 mm lens on a 36 mm sensor, and position (3,) of the object's origin; vertices (V, 3) turned."""
    height, width = size
    focal = max(size) * float(np.exp(rng.uniform(np.log(35), np.log(100)))) / 36
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent, fill = (high - low)[:2], rng.uniform(*_FILL[framing])
    distance = focal * float((extent / (fill * np.array([width, height]))).max())
    room = np.array([width, height]) * distance / focal - extent
    reach = np.abs(room) / 2 if framing in ("whole", "small") else np.abs(room) / 2 + 0.35 * extent
    offset = rng.uniform(-1, 1, 2) * reach * (0.95 if framing != "full" else 0.4)
    middle = np.array([*offset, -distance - (high[2] - low[2]) / 2])
    view = View(focal=focal, center=((width - 1) / 2, (height - 1) / 2), scale=1.0)
    return view, middle - (low + high) / 2


def _planes(place: Floats, backdrop: Backdrop, rng: np.random.Generator) -> Floats:
    """Planes (P, 4) of a backdrop behind the object's vertices (V, 3), camera frame; form of `MaskView.planes`."""
    tilt = np.radians(rng.uniform(-12, 12, 2))
    wall = np.array([np.sin(tilt[0]), np.sin(tilt[1]), 1.0])
    if backdrop == "cloth":
        lean = np.radians(rng.uniform(0, 40))
        floor = np.array([0.3 * rng.normal() * np.sin(lean), np.sin(lean), np.cos(lean)])
        return np.array([_behind(place, floor, 0.0)])
    if backdrop == "wall":
        gap = float(np.exp(rng.uniform(np.log(0.02), np.log(2.5)))) if rng.random() < 0.8 else 0.0
        return np.array([_behind(place, wall, gap)])
    lean = np.radians(rng.uniform(6, 55))
    table = np.array([0.06 * rng.normal(), np.cos(lean), np.sin(lean)])
    return np.array([_behind(place, table, 0.0), _behind(place, wall, float(np.exp(rng.uniform(-3, 1.2))))])


def _behind(place: Floats, normal: Floats, gap: float) -> Floats:
    """Plane that the object touches, or at a distance `gap` behind it."""
    normal = normal / np.linalg.norm(normal)
    return np.array([*normal, (place @ normal).min() - gap])
