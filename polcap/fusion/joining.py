"""Joins sets of views between which the object was laid on another side, by the shape and albedo that each set shows.

Each set alone gives a closed mesh on its own board. One mesh is moved onto the other: of many sampled turns, the best
by distances, normals and albedos of nearest points are refined by iterated closest points.

References
----------
Besl & McKay, A method for registration of 3-D shapes, IEEE TPAMI 1992; Chen & Medioni, Object modelling by registration
of multiple range images, Image and Vision Computing 1992 (distances from planes).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from polcap.errors import CaptureError
from polcap.formats.capture.folder_names import set_of_view
from polcap.fusion.normal_surface import visible
from polcap.fusion.shape import ShapeSettings, fuse_shape
from polcap.fusion.small_views import reduce_views, sample
from polcap.fusion.values import FusionView, Pose
from polcap.image_values import Floats
from polcap.optics.frames import dot
from polcap.optics.vertex_frames import vertex_normals
from polcap.stages import stage

_GRID = 80  # steps along a set's own mesh, which is for this registration alone
_LEAST_SEEN = 0.3  # least sum of the cosines between a point's normal and the views that see it
_TURNS = 3000  # sampled: every turn is within about 15° of one of them
_SHIFTS = 3  # tried with each turn
_TRIED = 40  # best of these motions, which are refined
_FEW, _MANY = 400, 8000  # points of the moved surface, in the search (ten times as many of the fixed) and at the end
_NORMAL = 0.4  # 1σ of the difference of two normals of one point
_ALBEDO = 0.1  # the same of albedos
_CLOSE = (0.06, 0.03, 0.015, 0.008, 0.004)  # 1σ of distances over the object's size, from the search to the last rounds
_ROUNDS = 6  # of iterated closest points with each 1σ
_FAR = 3.0  # σ; points that differ by more have no partner
_ALONG = 0.1  # weight of distances along the surface over that of distances from it


@dataclass(frozen=True)
class ObservedSurface:
    """Points that a set of views saw, in the frame of its board."""

    point: Floats  # (P, 3) m
    normal: Floats  # (P, 3) unit
    albedo: Floats  # (P, 3)
    middle: Floats  # (3,) m, of the closed mesh, with its unseen parts

    @property
    def size(self) -> float:
        """Longest side of the points' box, m."""
        return float(np.ptp(self.point, axis=0).max())

    def subsample(self, count: int, random: np.random.Generator) -> "ObservedSurface":
        """`count` random points, or all if there are fewer."""
        index = random.choice(len(self.point), min(count, len(self.point)), replace=False)
        return ObservedSurface(self.point[index], self.normal[index], self.albedo[index], self.middle)

    def features(self, close: float) -> Floats:
        """Positions, normals and albedos (P, 9) in units of their 1σ; `close` is that of positions, m."""
        return np.concatenate([self.point / close, self.normal / _NORMAL, self.albedo / _ALBEDO], axis=1)


@dataclass(frozen=True)
class Motion:
    """A rigid motion: point -> rotation @ point + translation."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,) m

    def apply(self, surface: ObservedSurface) -> ObservedSurface:
        """The moved surface."""
        point = surface.point @ self.rotation.T + self.translation
        middle = self.rotation @ surface.middle + self.translation
        return ObservedSurface(point, surface.normal @ self.rotation.T, surface.albedo, middle)

    def pose(self, before: Pose) -> Pose:
        """The pose of a view after the object and its board were moved."""
        rotation = before.rotation @ self.rotation.T
        return Pose(rotation, before.translation - rotation @ self.translation)


@dataclass(frozen=True)
class JoinedSet:
    """Motion of a further set of views onto the first one."""

    folder: str  # name of the set, and of its folder
    motion: Motion
    shared: float  # share of the set's surface that the first one confirms


@stage(version=4, uses=(fuse_shape,))
def join(views: tuple[FusionView, ...]) -> tuple[JoinedSet, ...]:
    """Find the motions of all further sets of views, each in a folder of its own, onto the first one."""
    sets: dict[str, list[FusionView]] = {}
    for view in views:
        sets.setdefault(set_of_view(view.name), []).append(view)
    first, *others = sets
    if not others:
        return ()
    fixed = observe_surface(sets[first])
    return tuple(JoinedSet(name, *register(observe_surface(sets[name]), fixed)) for name in others)


def require_shared(joined: Sequence[JoinedSet], least: float) -> None:
    """Raise CaptureError if the first set confirms less than the share `least` of the surface of another set."""
    for one in joined:
        if one.shared < least:
            raise CaptureError(
                f"{one.folder}: the first set confirms {one.shared:.0%} of this set's surface, "
                f"fusion.gates.min_shared = {least:.0%} is needed; show the same object, with some sides in both sets"
            )


def place(views: tuple[FusionView, ...], joined: tuple[JoinedSet, ...]) -> tuple[FusionView, ...]:
    """The views of all sets in the frame of the first set's board."""
    motions = {one.folder: one.motion for one in joined}
    out = []
    for view in views:
        motion = motions.get(set_of_view(view.name))  # None: of the first set
        out.append(view if motion is None else replace(view, pose=motion.pose(view.pose)))
    return tuple(out)


def observe_surface(views: Sequence[FusionView]) -> ObservedSurface:
    """Points of the object that a set of views saw."""
    mesh, small = fuse_shape(views, ShapeSettings(grid=_GRID)), reduce_views(views)
    outward = vertex_normals(mesh.vertices, mesh.faces)
    step = float(np.ptp(mesh.vertices, axis=0).max()) / _GRID
    cosine = np.stack([np.maximum(dot(outward, view.towards(mesh.vertices)), 0) for view in small])
    diffuse = np.stack([sample(view.diffuse, view.pixels(mesh.vertices)) for view in small])
    weight = visible(mesh, outward, small, step) * cosine  # (N, V)
    total = weight.sum(axis=0)
    seen = np.flatnonzero(total > _LEAST_SEEN)
    albedo = np.einsum("nv,nvc->vc", weight[:, seen], diffuse[:, seen]) / total[seen, None]
    return ObservedSurface(mesh.vertices[seen], outward[seen], albedo, mesh.vertices.mean(axis=0))


def register(moving: ObservedSurface, fixed: ObservedSurface) -> tuple[Motion, float]:
    """The motion of one surface onto another, and the share of its points that then have a partner there."""
    random = np.random.default_rng(0)
    few, coarse = moving.subsample(_FEW, random), fixed.subsample(10 * _FEW, random)
    find_coarse = _partner_search(coarse, _CLOSE[1])

    def misfit(motion: Motion) -> float:
        return float(np.mean(np.minimum(find_coarse(motion.apply(few))[0], _FAR) ** 2))

    best = min((_refine(motion, few, coarse, _CLOSE[:2]) for motion in _search_turns(few, coarse)), key=misfit)
    many = moving.subsample(_MANY, random)
    motion = _refine(best, many, fixed, _CLOSE[1:])
    difference, _ = _partner_search(fixed, _CLOSE[2])(motion.apply(many))
    return motion, float(np.isfinite(difference).mean())


def _search_turns(moving: ObservedSurface, fixed: ObservedSurface) -> list[Motion]:
    """The best motions: of many turns, each with middle on middle, and then shifted towards the nearest points."""
    tree, close = cKDTree(fixed.point), _CLOSE[0] * fixed.size
    features = fixed.features(close)
    found = []
    for turn in Rotation.random(_TURNS, rng=0).as_matrix():
        motion = Motion(turn, fixed.middle - turn @ moving.middle)
        for _ in range(_SHIFTS):
            moved = motion.apply(moving)
            _, index = tree.query(moved.point)
            squared = np.sum((moved.features(close) - features[index]) ** 2, axis=1)  # σ²
            weight = np.exp(-squared / 4) + 1e-9  # never all 0
            shift = np.average(fixed.point[index] - moved.point, axis=0, weights=weight)
            found.append((np.minimum(squared, _FAR**2).mean(), motion))
            motion = Motion(turn, motion.translation + shift)
    return [motion for _, motion in sorted(found, key=lambda one: one[0])[:_TRIED]]


def _partner_search(fixed: ObservedSurface, close: float) -> Callable[[ObservedSurface], tuple[Floats, Floats]]:
    """Search for the points of a surface that are most like others; `close` is the 1σ of distances over its size.

    For P points, it returns their differences (P,) σ from these partners, infinite beyond _FAR, and indices (P,).
    """
    sigma = close * fixed.size
    tree = cKDTree(fixed.features(sigma))

    def find(moved: ObservedSurface) -> tuple[Floats, Floats]:
        difference, index = tree.query(moved.features(sigma), distance_upper_bound=_FAR)
        return np.asarray(difference), np.asarray(index)

    return find


def _refine(motion: Motion, moving: ObservedSurface, fixed: ObservedSurface, closes: Sequence[float]) -> Motion:
    """A motion after iterated closest points, with each 1σ of distances in `closes` [sizes of the object] in turn."""
    for close in closes:
        find = _partner_search(fixed, close)
        for _ in range(_ROUNDS):
            moved = motion.apply(moving)
            difference, index = find(moved)
            paired = np.isfinite(difference)
            if paired.sum() < 6:  # a motion has six unknowns
                return motion
            partner, weight = index[paired], 1 / (1 + difference[paired] ** 2)  # Cauchy
            motion = _step_to_planes(motion, moved.point[paired], fixed.point[partner], fixed.normal[partner], weight)
    return motion


def _step_to_planes(motion: Motion, point: Floats, target: Floats, normal: Floats, weight: Floats) -> Motion:
    """The motion, followed by a small one that brings points nearest to their targets' planes (least squares)."""
    middle = point.mean(axis=0)
    axes = [normal, *(np.broadcast_to(_ALONG * axis, normal.shape) for axis in np.eye(3))]
    rows = [np.concatenate([np.cross(point - middle, axis), axis], axis=1) * weight[:, None] for axis in axes]
    off = [dot(axis, target - point) * weight for axis in axes]
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(off), rcond=None)[0]
    turn = Rotation.from_rotvec(found[:3]).as_matrix()
    return Motion(turn @ motion.rotation, turn @ (motion.translation - middle) + middle + found[3:])
