"""Traced views of objects before a backdrop, without materials, for the pictures of the mask's training.

The unit of length is the longest side of the object. Positions are in the camera frame of `optics/frames.py`, with the
lens at the origin. The backdrop is one or two planes: a wall behind the object; a table and a wall behind it; or a
cloth on which the object lies.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats, View
from polcap.optics import frames
from polcap.optics.mesh_tracer import GBuffer, Tracer, Triangles, centred, union
from polcap.training import random_shapes

Framing = Literal["whole", "small", "cut", "full"]
Backdrop = Literal["wall", "table", "cloth"]
_LIFT = 2e-3  # from a surface to the start of a ray to the flash
_TRIES = 60  # random sides per framing
_MIN_COVER = 0.004  # least share of the picture that the object covers
_FRAMINGS: dict[Framing, tuple[float, float, float, float]] = {
    # probability; least and greatest extent of the object over that of the picture; its greatest share of the picture
    "whole": (0.66, 0.35, 0.95, 0.8),
    "small": (0.12, 0.15, 0.35, 0.4),
    "cut": (0.16, 0.6, 1.2, 0.85),
    "full": (0.06, 1.3, 2.2, 0.97),
}


@dataclass(frozen=True)
class ViewKind:
    """Composition of a traced view: framing, kind of backdrop, position of the flash."""

    framing: Framing
    backdrop: Backdrop
    flash_offset: tuple[float, float]  # least and greatest distance from lens to flash [object distances]


@dataclass(frozen=True)
class MaskView:
    """A view of an object before a backdrop, H×W pixels."""

    object: GBuffer
    lit: Bools  # (H, W) the flash reaches the object or the backdrop
    turn: Floats  # (3, 3) rotation from the object's frame to the camera's
    distance: float  # of the object's center
    flash: Floats  # (3,)
    planes: Floats  # (P, 4) backdrop: unit normal towards the camera, and its product with a point of the plane


def draw_kind(rng: np.random.Generator) -> ViewKind:
    """Draw a random composition; difficult ones are more frequent than in photographs."""
    framing: Framing = rng.choice(list(_FRAMINGS), p=[kind[0] for kind in _FRAMINGS.values()])
    backdrop: Backdrop = rng.choice(["wall", "table", "cloth"], p=[0.4, 0.4, 0.2])
    return ViewKind(framing, backdrop, (0.2, 0.7) if rng.random() < 0.3 else (0.0, 0.15))


def side_by_side(meshes: list[Triangles], rng: np.random.Generator) -> Triangles:
    """Join meshes of longest side 1 into one mesh, side by side with small gaps or overlaps."""
    parts, edge = [], 0.0
    for mesh in meshes:
        turn = random_shapes.rotation(rng)
        turned = mesh.vertices @ turn.T * rng.uniform(0.4, 1.0)
        turned += [edge, rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)] - turned.min(axis=0)
        edge = float(turned[:, 0].max()) + rng.uniform(-0.05, 0.3)
        parts.append(Triangles(turned.astype(np.float32), mesh.faces, mesh.corner_normals @ turn.T.astype(np.float32)))
    return centred(union(parts))


def trace_view(tracer: Tracer, kind: ViewKind, size: tuple[int, int], rng: np.random.Generator) -> MaskView | None:
    """Trace the object from a random side, with a random flash and backdrop; None if it cannot be framed like this."""
    _, _, _, max_cover = _FRAMINGS[kind.framing]
    for _ in range(_TRIES):
        turn = random_shapes.rotation(rng)
        view, place = _frame(tracer.mesh.vertices @ turn.T, kind.framing, size, rng)
        if place[2] > -0.8:  # not too near the lens
            continue
        buffer = tracer.trace(turn, place, view, *size)
        mask = buffer.mask
        edge = np.concatenate([mask[[0, -1]].ravel(), mask[:, [0, -1]].ravel()]).mean()
        if _MIN_COVER < mask.mean() < max_cover and (edge > 0.01) == (kind.framing in ("cut", "full")):
            break
    else:
        return None
    distance = float(np.linalg.norm(place))
    offset, azimuth = rng.uniform(*kind.flash_offset) * distance, rng.normal(np.pi / 2, 0.9)
    flash = np.array([offset * np.cos(azimuth), offset * np.sin(azimuth), 0.0])
    planes = _draw_planes(tracer.mesh.vertices @ turn.T + place, kind.backdrop, rng)
    v = frames.rays(view, *size)  # unit, towards the lens: a surface at distance d is at −d·v
    behind, _, _ = meet_planes(planes, v.reshape(-1, 3))
    behind = np.where(np.isfinite(behind), behind, 1e3).reshape(size)
    far = np.where(mask, buffer.depth / v[..., 2], behind)  # distance of object or backdrop
    start = _LIFT * buffer.normal - v * far[..., None] - place  # from the object's center
    lit = ~tracer.hidden(start.reshape(-1, 3) @ turn, (flash - place) @ turn).reshape(size)
    return MaskView(buffer, lit, turn, distance, flash, planes)


def meet_planes(planes: Floats, v: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Intersect rays −v (N, 3) with the backdrop's planes (P, 4).

    Returns the distance (N,) to the nearest plane, infinite without one, its normal (N, 3) and number (N,).
    """
    facing = v @ planes[:, :3].T  # (N, P)
    distance = np.where(facing > 1e-3, -planes[:, 3] / np.maximum(facing, 1e-3), np.inf)
    distance = np.where(distance > 0, distance, np.inf)
    first = distance.argmin(axis=1)
    return distance[np.arange(len(v)), first], planes[first, :3], first


def _frame(turned: Floats, framing: Framing, size: tuple[int, int], rng: np.random.Generator) -> tuple[View, Floats]:
    """Camera view (35–100 mm lens, 36 mm sensor) and object position (3,) that frame rotated vertices (V, 3)."""
    side = np.array(size[::-1])  # width, height
    focal = side.max() * random_shapes.log_uniform(35, 100, rng) / 36
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent, fill = (high - low)[:2], rng.uniform(*_FRAMINGS[framing][1:3])
    distance = focal * float((extent / (fill * side)).max())
    reach = np.abs(side * distance / focal - extent) / 2
    if framing in ("cut", "full"):
        reach = reach + 0.35 * extent
    offset = rng.uniform(-1, 1, 2) * reach * (0.4 if framing == "full" else 0.95)
    middle = np.array([*offset, -distance - (high[2] - low[2]) / 2])
    view = View(focal=float(focal), center=((side[0] - 1) / 2, (side[1] - 1) / 2), scale=1.0)
    return view, middle - (low + high) / 2


def _draw_planes(place: Floats, backdrop: Backdrop, rng: np.random.Generator) -> Floats:
    """Planes (P, 4) of a backdrop behind the object's vertices (V, 3), camera frame; form of `MaskView.planes`."""
    tilt = np.radians(rng.uniform(-12, 12, 2))
    wall = np.array([np.sin(tilt[0]), np.sin(tilt[1]), 1.0])
    if backdrop == "cloth":
        lean = np.radians(rng.uniform(0, 40))
        cloth = np.array([0.3 * rng.normal() * np.sin(lean), np.sin(lean), np.cos(lean)])
        return np.array([_behind(place, cloth, 0.0)])
    if backdrop == "wall":
        gap = random_shapes.log_uniform(0.02, 2.5, rng) if rng.random() < 0.8 else 0.0
        return np.array([_behind(place, wall, gap)])
    lean = np.radians(rng.uniform(6, 55))
    table = np.array([0.06 * rng.normal(), np.cos(lean), np.sin(lean)])
    return np.array([_behind(place, table, 0.0), _behind(place, wall, float(np.exp(rng.uniform(-3, 1.2))))])


def _behind(place: Floats, normal: Floats, gap: float) -> Floats:
    """Plane with this normal behind the object's vertices: touching the object, or at a distance `gap`."""
    normal = normal / np.linalg.norm(normal)
    return np.array([*normal, (place @ normal).min() - gap])
