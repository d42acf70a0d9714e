"""Camera and poses of a session without a board, from features of the object (bundle adjustment of planar motion).

The camera is fixed and the object turns on a flat table, so features outside the masks do not count, and all views turn
about one axis. The measured normals of matching features give a first turn between two views; from features alone it
is nearly ambiguous through a long lens.

World frame: y is the axis, upwards as the camera sees it; the origin is on it, below the lowest features.

References
----------
Horn, Closed-form solution of absolute orientation, JOSA A 1987. Golub & Pereyra, Separable nonlinear least squares,
Inverse Problems 2003 (points eliminated).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix, csgraph
from scipy.spatial.transform import Rotation

from polcap.capture_values import Capture
from polcap.errors import CaptureError
from polcap.fusion.object_features import ObjectFeatures
from polcap.fusion.poses import LEAST_VIEWS, PosedView, SessionCamera, SessionPoses
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Floats
from polcap.optics.frames import dot, unit
from polcap.stages import stage

_RATIO = 0.85  # largest distance of the nearest descriptor over that of the second nearest
_SAMPLES = 200  # pairs of matches, each of which gives a rotation between two views that is tried
_AGREES = np.radians(15.0)  # between matching normals after the right turn; normals of single views err by 3 to 8°
_LEAST_MATCHES = 12  # of two views, with agreeing normals; these must also be a third of all matches
_MOST_POINTS = 3000  # in the adjustment, whose time grows with them: those that most views see
_NORMAL_SIGMA = np.radians(5.0)  # 1σ of a normal, in the first turns
_SCALES_PX = (12.0, 6.0, 3.0, 1.5, 1.0, 1.0)  # of the Cauchy weights, by round; the first turns err by some pixels
_FAR = 3.0  # times the last of these; features beyond are wrong matches
_SHIFT_SIGMA = 0.02  # 1σ of an object's motion on the table besides the turn, over the distance of the lens
_HELD = 1e-4  # 1σ by which the origin's height and the first turn are held near 0: the features do not determine them
_STEPS = 12  # of the adjustment in a round
_WRONG = 0.01  # share of the lowest and of the highest features that may be wrong
_BELOW = 0.15  # from the lowest feature down to y = 0, over the range of heights; the object's foot often shows none
# places of the unknowns in `_Motion.value`
_TILT = slice(0, 2)  # of the axis about x and z [rad]
_AXIS_X, _AXIS_Y = 2, 3  # position of the axis in the camera frame, over its distance from the lens
_FOCAL = 4  # ln of the change of the focal length
_TURNS = 5  # first of the N turns [rad]; then N shifts along x of the table, and N along z
_Pair = tuple[int, int]  # numbers of two views
_Matches = NDArray[np.intp]  # (M, 2) numbers of features


@dataclass(frozen=True)
class _FeatureTracks:
    """Features of points that two views or more see; a point's features are a track."""

    view: NDArray[np.intp]  # (M,) number of the view
    point: NDArray[np.intp]  # (M,) number of the track
    ray: Floats  # (M, 2)


@dataclass(frozen=True)
class _Motion:
    """Axis and position of the turntable, focal length, and motion of each view on the table."""

    base: Rotation  # world to camera at turn 0, before the correction `_TILT` of the axis
    value: Floats  # (5 + 3 N,) unknowns, at the places above

    def poses(self) -> tuple[Floats, Floats]:
        """Rotations (N, 3, 3) and translations (N, 3), world to camera; the lens is 1 from the axis."""
        about_x, about_z = self.value[_TILT]
        tilt = Rotation.from_rotvec([about_x, 0.0, about_z]) * self.base
        turn, across, along = self.value[_TURNS:].reshape(3, -1)
        shift = tilt.apply(np.stack([across, np.zeros_like(across), along], axis=-1))
        turned = tilt * Rotation.from_rotvec(np.outer(turn, [0.0, 1.0, 0.0]))
        return turned.as_matrix(), shift + np.array([self.value[_AXIS_X], self.value[_AXIS_Y], -1.0])

    @property
    def focal_change(self) -> float:
        """Adjusted focal length over the one that the capture states."""
        return float(np.exp(self.value[_FOCAL]))


@dataclass(frozen=True)
class _AdjustedMotion:
    """Motion with its errors, and the residual of the features."""

    tracks: _FeatureTracks
    motion: _Motion
    sigma: Floats  # 1σ of the unknowns
    error: Floats  # (M, 2) slopes of the points minus those of their features
    inlier: Bools  # (M,) features that are no wrong matches


@stage(version=1)
def solve(features: Mapping[str, ObjectFeatures], capture: Capture) -> SessionPoses:
    """Camera and poses of views from their features; `capture` is one of them and states the camera's geometry.

    Views without enough features in common with the others are left out. Lengths are in metres if the chart's size is
    known; otherwise the lens is 1 from the axis.

    Raises CaptureError: fewer than three views have enough features in common.
    """
    names, found = list(features), list(features.values())
    pairs = {(i, j): _match(found[i], found[j]) for i, j in combinations(range(len(names)), 2)}
    views, start = _first_motion(found, pairs)
    if len(views) < LEAST_VIEWS:
        raise _too_few(0, len(names))
    tracks, distance = _tracks(found, pairs, start, views), found[0].distance_m
    doubt = max(*np.abs(capture.focal_doubt), 0.002 if capture.focal_known else 0.5)  # relative, 1σ
    adjusted = _adjust(tracks, start, found[0].focal, float(doubt))
    posed = _pose_views(adjusted, [names[k] for k in views], distance or 1.0, capture.focal_px)
    if len(posed) < LEAST_VIEWS:
        raise _too_few(len(posed), len(names))
    reason = f"fewer than {_LEAST_MATCHES} features of the object match those of other views; turn it by 15° or less"
    left_out = {name: reason for name in names if name not in {one.name for one in posed}}
    camera = _camera(capture, found[0].bend, adjusted)
    return SessionPoses(camera, tuple(posed), left_out, metric=distance is not None)


def _too_few(posed: int, count: int) -> CaptureError:
    """Error of a session with too few posed views of `count`."""
    return CaptureError(
        f"no view shows a board, and {posed} of {count} views have {_LEAST_MATCHES} features of the object in common "
        f"with others, {LEAST_VIEWS} are needed; shoot with the object on the board of `polcap board`, or turn it by "
        "15° or less between the views and let it fill the picture"
    )


def _camera(capture: Capture, bend: tuple[float, float], found: _AdjustedMotion) -> SessionCamera:
    """Camera with the adjusted focal length, and with the stated distortion: an object in the middle shows none."""
    focal = capture.focal_px * found.motion.focal_change
    return SessionCamera(focal, focal * float(found.sigma[_FOCAL]), capture.principal_px, *bend)


def _pose_views(found: _AdjustedMotion, names: Sequence[str], distance: float, focal_px: float) -> list[PosedView]:
    """Poses of the views with enough features; the lens is `distance` from the axis."""
    tracks, motion = found.tracks, found.motion
    point = _points(tracks, motion, found.inlier.astype(float))[0]
    height = point[tracks.point[found.inlier], 1]
    foot = float(np.quantile(height, _WRONG) - _BELOW * np.ptp(np.quantile(height, [_WRONG, 1 - _WRONG])))
    turns, shifts = motion.poses()
    out = []
    for k, (name, turn, shift) in enumerate(zip(names, turns, shifts, strict=True)):
        own = found.inlier & (tracks.view == k)
        if own.sum() >= _LEAST_MATCHES:
            residual = float(np.sqrt(2 * np.mean(found.error[own] ** 2))) * focal_px  # rms, both axes
            sigma = float(np.degrees(np.hypot(found.sigma[_TURNS + k], found.sigma[_TILT].max())))
            pose = Pose(turn, distance * (shift + foot * turn[:, 1]))
            out.append(PosedView(name, pose, int(own.sum()), residual, sigma))
    return out


def _match(one: ObjectFeatures, other: ObjectFeatures) -> _Matches:
    """Numbers (M, 2) of features that are each other's nearest, and nearer than the second nearest."""
    if min(len(one.ray), len(other.ray)) < _LEAST_MATCHES:
        return np.zeros((0, 2), np.intp)
    distance = np.sqrt(np.maximum(2 - 2 * one.descriptor @ other.descriptor.T, 0))
    i, j = np.arange(len(distance)), distance.argmin(axis=1)
    nearest, second = np.partition(distance, 1, axis=1)[:, :2].T
    good = (distance.argmin(axis=0)[j] == i) & (nearest < _RATIO * second)
    return np.stack([i[good], j[good]], axis=-1)


def _first_motion(
    features: Sequence[ObjectFeatures], pairs: Mapping[_Pair, _Matches]
) -> tuple[NDArray[np.intp], _Motion]:
    """The largest group of views that matches connect, and their motion, from normals alone.

    1. Matching normals give the rotation between two views: a turn about an axis that all pairs share.
    2. A tree of the pairs with most matches gives a first turn of each view.
    3. Least squares over all pairs gives the turns.
    """
    between = _rotations(features, pairs)
    if not between:
        return np.zeros(0, np.intp), _Motion(Rotation.identity(), np.zeros(_TURNS))
    (i, j), (rotations, counts) = np.array(list(between)).T, zip(*between.values())  # of each pair (P,)
    count = np.array(counts)
    axis, step = _about_shared_axis(Rotation.concatenate(rotations), count)
    cost, steps = np.zeros((2, len(features), len(features)))
    cost[i, j], steps[i, j], steps[j, i] = 1 / count, step, -step
    _, group = csgraph.connected_components(cost, directed=False)
    views = np.flatnonzero(group == np.argmax(np.bincount(group)))
    order, parent = csgraph.breadth_first_order(csgraph.minimum_spanning_tree(cost), views[0], directed=False)
    turn: Floats = np.zeros(len(features))
    for k in order[1:]:
        turn[k] = turn[parent[k]] + steps[parent[k], k]

    def residuals(turn: Floats) -> Floats:
        gap = turn[j] - turn[i] - step
        error = (gap - 2 * np.pi * np.rint(gap / (2 * np.pi))) * np.sqrt(count) / _NORMAL_SIGMA
        return np.append(error, turn[views[0]])  # the first view is at turn 0

    turn = least_squares(residuals, turn, loss="cauchy").x[views]
    middle = np.concatenate([features[k].ray for k in views.tolist()]).mean(axis=0)
    base = Rotation.align_vectors([axis], [[0.0, 1.0, 0.0]])[0]
    tilt, focal, shifts = np.zeros(2), np.zeros(1), np.zeros(2 * len(views))
    return views, _Motion(base, np.concatenate([tilt, middle, focal, turn, shifts]))


def _rotations(
    features: Sequence[ObjectFeatures], pairs: Mapping[_Pair, _Matches]
) -> dict[_Pair, tuple[Rotation, int]]:
    """Rotation from one view's normals to another's, and how many matches agree on it; by pair, if enough agree."""
    found = {}
    for (one, other), match in pairs.items():
        rotation, agreeing = _rotation(features[one].normal[match[:, 0]], features[other].normal[match[:, 1]])
        if agreeing >= max(_LEAST_MATCHES, len(match) / 3):
            found[one, other] = rotation, agreeing
    return found


def _about_shared_axis(between: Rotation, count: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """The axis (3,), pointing up, that P rotations share, and their turns (P,) [rad] about it; `count` are weights."""
    vector, quaternion = between.as_rotvec(), between.as_quat()
    axis = unit(np.sum(vector * (np.sign(vector[:, 1]) * count)[:, None], axis=0))
    return axis, 2 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3])


def _rotation(before: Floats, after: Floats) -> tuple[Rotation, int]:
    """Rotation with which most pairs of unit vectors (N, 3), before and after, agree (RANSAC); their number."""
    if len(before) < _LEAST_MATCHES:
        return Rotation.identity(), 0
    pick = np.random.default_rng(0).integers(len(before), size=(_SAMPLES, 2))
    tried = _frames(after[pick]) @ _frames(before[pick]).transpose(0, 2, 1)  # (S, 3, 3)
    agree = np.einsum("sij,nj,ni->sn", tried, before, after) > np.cos(_AGREES)
    best = agree[np.argmax(agree.sum(axis=1))]
    if best.sum() < _LEAST_MATCHES:
        return Rotation.identity(), 0
    return Rotation.align_vectors(after[best], before[best])[0], int(best.sum())


def _frames(pair: Floats) -> Floats:
    """Orthonormal frames (S, 3, 3), in columns, of two unit vectors each (S, 2, 3)."""
    third = unit(np.cross(pair[:, 0], pair[:, 1]) + 1e-9)
    return np.stack([pair[:, 0], np.cross(third, pair[:, 0]), third], axis=-1)


def _tracks(
    features: Sequence[ObjectFeatures], pairs: Mapping[_Pair, _Matches], first: _Motion, views: NDArray[np.intp]
) -> _FeatureTracks:
    """Tracks of features of some views whose normals match after the first turns, one feature in each view."""
    start = np.cumsum([0, *(len(one.ray) for one in features)])
    normal, ray = (np.concatenate([getattr(one, name) for one in features]) for name in ("normal", "ray"))
    view = np.repeat(np.arange(len(features)), np.diff(start))
    turns = np.zeros((len(features), 3, 3))  # 0 for views that are not used
    turns[views] = first.poses()[0]
    one, other = np.concatenate([start[list(pair)] + match for pair, match in pairs.items()]).T  # numbers in all views
    world = np.einsum("nji,nj->ni", turns[view], normal)
    good = dot(world[one], world[other]) > np.cos(_AGREES)
    joined = coo_matrix((good[good], (one[good], other[good])), shape=(len(view),) * 2)
    _, track = csgraph.connected_components(joined, directed=False)
    use = np.unique(np.stack([track, view]), axis=1, return_index=True)[1]  # one feature of a track in each view
    size = np.bincount(track[use])
    longest = np.argsort(-size, kind="stable")[:_MOST_POINTS]
    use = use[(size[track[use]] > 1) & np.isin(track[use], longest)]
    return _FeatureTracks(np.searchsorted(views, view[use]), np.unique(track[use], return_inverse=True)[1], ray[use])


def _adjust(tracks: _FeatureTracks, first: _Motion, focal_px: float, doubt: float) -> _AdjustedMotion:
    """The motion that fits the tracks best; `doubt` is the 1σ of the logarithm of the focal length."""
    count = (len(first.value) - _TURNS) // 3
    prior = np.full(len(first.value), np.inf)  # 1σ; infinite: none
    prior[_AXIS_Y], prior[_FOCAL], prior[_TURNS] = _HELD, doubt, _HELD
    prior[_TURNS + count :] = _SHIFT_SIGMA
    value, weight = first.value, np.ones(len(tracks.view))
    for scale in _SCALES_PX:

        def residuals(value: Floats, weight: Floats = weight, scale: float = scale) -> Floats:
            error = _errors(tracks, _Motion(first.base, value), weight) * focal_px / scale
            return np.concatenate([np.ravel(error), (value - first.value) / prior])

        best = least_squares(residuals, value, x_scale="jac", loss="cauchy", max_nfev=_STEPS)
        value = best.x
        error = _errors(tracks, _Motion(first.base, value), weight)
        far = np.linalg.norm(error, axis=1) * focal_px / scale
        weight = 1 / np.sqrt(1 + far**2)
    inlier, jacobian = far < _FAR, np.asarray(best.jac)
    spread = float(np.sqrt(np.mean(error[inlier] ** 2))) * focal_px / scale
    sigma = spread * np.sqrt(np.abs(np.diag(np.linalg.pinv(jacobian.T @ jacobian))))
    return _AdjustedMotion(tracks, _Motion(first.base, value), sigma, error, inlier)


def _points(tracks: _FeatureTracks, motion: _Motion, weight: Floats) -> tuple[Floats, Floats]:
    """World points (P, 3) nearest to their rays, by linear least squares, and their slopes (M, 2) in the views.

    A ray (x, y) of the view with rotation R and translation t fulfills (R X + t)_x + x (R X + t)_z = 0, and the same
    holds for y.
    """
    turn, shift = (part[tracks.view] for part in motion.poses())
    ray = tracks.ray / motion.focal_change
    terms = (turn[:, :2] + ray[..., None] * turn[:, 2:]) * weight[:, None, None]  # (M, 2, 3)
    right = -(shift[:, :2] + ray * shift[:, 2:]) * weight[:, None]  # (M, 2)
    count = int(tracks.point.max()) + 1
    square, side = np.zeros((count, 3, 3)), np.zeros((count, 3, 1))
    np.add.at(square, tracks.point, np.einsum("mki,mkj->mij", terms, terms))
    np.add.at(side[..., 0], tracks.point, np.einsum("mki,mk->mi", terms, right))
    point = np.linalg.solve(square + 1e-9 * np.eye(3), side)[..., 0]
    in_camera = np.einsum("mij,mj->mi", turn, point[tracks.point]) + shift
    return point, -in_camera[:, :2] / in_camera[:, 2:] * motion.focal_change


def _errors(tracks: _FeatureTracks, motion: _Motion, weight: Floats) -> Floats:
    """Slopes (M, 2) of the points minus those of their features."""
    return np.asarray(_points(tracks, motion, weight)[1] - tracks.ray)
