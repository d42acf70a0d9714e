"""One camera and a pose of the board per view, from the board's corners in all views (bundle adjustment).

Focal length, distortion k₁ and k₂, and six numbers per view minimize the distances between measured and projected
corners. Turns of one plane about its normal do not determine the principal point, so it is held near the stated one.

References
----------
Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000; Zhang, A flexible new technique for camera calibration,
IEEE TPAMI 2000.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from polcap.capture_values import Capture
from polcap.errors import CaptureError
from polcap.fusion.board_corners import BoardCorners
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Distortion, Floats, View
from polcap.optics import distortion, projection
from polcap.optics.board import Board
from polcap.stages import stage

LEAST_VIEWS = 3
_MOST_RESIDUAL = 1.0  # px rms of a view's corners; a flat, sharp board leaves 0.02 to 0.1
_CORNER_SIGMA = 0.05  # px, 1σ of a corner; the robust loss begins at 3σ
_OUTLIER = 5.0  # times the robust spread of all corners, at least `_LEAST_OUTLIER` px
_LEAST_OUTLIER = 0.5  # px
_LEAST_INLIERS = 0.75  # of a view's corners; where more are outliers, all are used
_PRINCIPAL_SIGMA = 0.002  # 1σ about the stated one, over the picture's width: where lenses have their axis
_BEND_SIGMA = 0.3, 1.0  # of k₁ and k₂ where nothing else is known
_CAMERA = 5  # unknowns of the camera: ln focal length, principal point, k₁, k₂
_STEPS = np.array([1e-6, 1e-3, 1e-3, 1e-5, 1e-4, *[1e-6] * 6])  # of the derivatives: camera; rad and m of a view
_TO_CV = np.diag([1.0, -1.0, -1.0])  # camera frame of this package to OpenCV's


@dataclass(frozen=True)
class SessionCamera:
    """Camera of all views, on visible RAW pixels, with the 1σ of its focal length."""

    focal_px: float
    focal_sigma_px: float
    principal_px: tuple[float, float]
    k1: float
    k2: float

    @property
    def view(self) -> View:
        """The pinhole camera, on visible RAW pixels."""
        return View(self.focal_px, self.principal_px, 1.0)

    @property
    def lens(self) -> Distortion:
        """The lens distortion, on visible RAW pixels."""
        return Distortion(self.focal_px, self.principal_px, self.k1, self.k2)

    def reduced(self, scale: float) -> "SessionCamera":
        """The camera on a grid whose pixels are `scale` RAW pixels wide."""
        x, y = (projection.to_grid(at, scale) for at in self.principal_px)
        return SessionCamera(self.focal_px / scale, self.focal_sigma_px / scale, (x, y), self.k1, self.k2)

    def project(self, pose: Pose, world: Floats) -> Floats:
        """Visible RAW pixels (N, 2) of the photograph that show world points (N, 3) [m]."""
        x, y = projection.project(self.view, pose.to_camera(world)).T
        return np.stack(distortion.distort(self.lens, x, y), axis=-1)


@dataclass(frozen=True)
class PosedView:
    """Pose of one view with its errors."""

    name: str
    pose: Pose
    corners: int  # or features, used
    residual_px: float  # their rms, RAW px
    sigma_deg: float  # 1σ of the rotation, largest axis


@dataclass(frozen=True)
class SessionPoses:
    """Camera and poses of a session, and why views were left out."""

    camera: SessionCamera
    posed: tuple[PosedView, ...]
    left_out: Mapping[str, str]
    metric: bool = True  # lengths are in metres
    board: Board | None = None  # from which the poses are; None: from features of the object

    @property
    def views(self) -> Mapping[str, PosedView]:
        """Posed views by name."""
        return {one.name: one for one in self.posed}


@stage(version=1)
def solve(boards: Mapping[str, BoardCorners], capture: Capture) -> SessionPoses:
    """Camera and poses of all views of a session; `capture` is one of them and states the camera's geometry.

    A view whose corners do not fit is left out, and the others are solved again.

    Raises CaptureError: fewer than three views can be posed, or views show boards of several sizes.
    """
    sizes = {corners.board.name for corners in boards.values()}
    if len(sizes) > 1:
        raise CaptureError(f"the views show boards of sizes {' and '.join(sorted(sizes))}; use one board for all")
    names = list(boards)
    left_out: dict[str, str] = {}
    while True:
        if len(names) < LEAST_VIEWS:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
            raise CaptureError(
                f"{len(names)} views can be posed, {LEAST_VIEWS} are needed; show the board in more views"
                + (f" ({reasons})" if reasons else "")
            )
        camera, posed = _adjust({name: boards[name] for name in names}, capture)
        worst = max(posed, key=lambda view: view.residual_px)
        if worst.residual_px <= _MOST_RESIDUAL:
            return SessionPoses(camera, tuple(posed), left_out, board=boards[names[0]].board)
        names.remove(worst.name)
        left_out[worst.name] = (
            f"its corners are {worst.residual_px:.1f} px (rms) from those of the board, the limit is "
            f"{_MOST_RESIDUAL:g} px; keep the board flat, focus and zoom unchanged"
        )


def _adjust(seen: Mapping[str, BoardCorners], capture: Capture) -> tuple[SessionCamera, list[PosedView]]:
    """Bundle adjustment, twice: the second time without corners far from the first solution."""
    boards = list(seen.values())
    stated = View(capture.focal_px, capture.principal_px, 1.0)
    start = np.concatenate([np.zeros(_CAMERA), *(_first_pose(one, stated) for one in boards)])
    found = _minimize(boards, capture, start)
    error = _residuals(boards, capture, found.x)
    limit_px = max(_OUTLIER * 1.48 * float(np.median(np.abs(np.concatenate(error)))), _LEAST_OUTLIER)
    used = [_select(one, np.linalg.norm(e, axis=1) <= limit_px) for one, e in zip(boards, error, strict=True)]
    found = _minimize(used, capture, found.x)
    return _with_errors(dict(zip(seen, used)), capture, found)


def _select(corners: BoardCorners, near: Bools) -> BoardCorners:
    """The corners that `near` (N,) selects; all of them where these are too few."""
    if near.sum() < _LEAST_INLIERS * len(near):
        return corners
    return BoardCorners(corners.board, corners.number[near], corners.world[near], corners.measured_px[near])


def _of_view(k: int) -> slice:
    """Unknowns of view k: rotation vector and translation [m], world to camera."""
    return slice(_CAMERA + 6 * k, _CAMERA + 6 * (k + 1))


def _first_pose(corners: BoardCorners, view: View) -> Floats:
    """Rotation vector and translation (6,) of a view, from its corners alone, for a camera without distortion."""
    to_flat = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # world to a frame with the board at z = 0
    count, turns, shifts, errors = cv2.solvePnPGeneric(
        corners.world @ to_flat.T, corners.measured_px, view.intrinsic, None, flags=cv2.SOLVEPNP_IPPE
    )
    best = min(range(count), key=lambda k: float(np.ravel(errors[k])[0]))
    vector = Rotation.from_matrix(_TO_CV @ cv2.Rodrigues(turns[best])[0] @ to_flat).as_rotvec()
    return np.concatenate([vector, _TO_CV @ np.ravel(shifts[best])])


def _camera(capture: Capture, unknown: Floats, sigma: float = 0.0) -> SessionCamera:
    """The camera of the first unknowns; `sigma` is the relative 1σ of its focal length."""
    x, y = capture.principal_px
    focal = capture.focal_px * float(np.exp(unknown[0]))
    return SessionCamera(
        focal, focal * sigma, (x + float(unknown[1]), y + float(unknown[2])), float(unknown[3]), float(unknown[4])
    )


def _pose(unknown: Floats) -> Pose:
    """The pose of a view's unknowns (6,)."""
    return Pose(Rotation.from_rotvec(unknown[:3]).as_matrix(), unknown[3:])


def _residual(corners: BoardCorners, camera: SessionCamera, unknown: Floats) -> Floats:
    """Projected minus measured corners (N, 2) px of a view with these unknowns (6,)."""
    return camera.project(_pose(unknown), corners.world) - corners.measured_px


def _residuals(boards: Sequence[BoardCorners], capture: Capture, unknown: Floats) -> list[Floats]:
    """Projected minus measured corners (N, 2) px of each view, for all unknowns."""
    camera = _camera(capture, unknown)
    return [_residual(one, camera, unknown[_of_view(k)]) for k, one in enumerate(boards)]


def _minimize(boards: Sequence[BoardCorners], capture: Capture, start: Floats) -> OptimizeResult:
    """Least squares of all unknowns from `start`; weak priors hold the camera's unknowns near 0, the stated camera."""
    width = capture.size_px[0]
    doubt = max(abs(capture.focal_doubt[0]), abs(capture.focal_doubt[1]), 0.05 if capture.focal_known else 0.5)
    prior = np.array([doubt, *[_PRINCIPAL_SIGMA * width] * 2, *_BEND_SIGMA])  # 1σ
    rows = np.cumsum([_CAMERA, *(2 * len(one.number) for one in boards)])  # first of each view

    def residual_of(k: int, unknown: Floats) -> Floats:  # of view k; unknowns (11,): camera, then this view
        return _residual(boards[k], _camera(capture, unknown), unknown[_CAMERA:]).ravel() / _CORNER_SIGMA

    def residuals(unknown: Floats) -> Floats:
        parts = [one.ravel() / _CORNER_SIGMA for one in _residuals(boards, capture, unknown)]
        return np.concatenate([unknown[:_CAMERA] / prior, *parts])

    def jacobian(unknown: Floats) -> Floats:
        out = np.zeros((rows[-1], len(unknown)))
        out[range(_CAMERA), range(_CAMERA)] = 1 / prior
        for k, (first, last) in enumerate(itertools.pairwise(rows)):
            own = np.r_[:_CAMERA, _of_view(k)]
            for column, step in zip(own, np.eye(len(own)) * _STEPS, strict=True):
                change = residual_of(k, unknown[own] + step) - residual_of(k, unknown[own] - step)
                out[first:last, column] = change / (2 * step.max())
        return out

    return least_squares(
        residuals, start, jacobian, x_scale="jac", loss="huber", f_scale=3.0, xtol=1e-12, ftol=1e-12, max_nfev=200
    )


def _with_errors(
    boards: Mapping[str, BoardCorners], capture: Capture, found: OptimizeResult
) -> tuple[SessionCamera, list[PosedView]]:
    """Camera and poses with their errors, from the curvature at the solution and the actual residuals."""
    errors = _residuals(list(boards.values()), capture, found.x)
    scale = float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) / _CORNER_SIGMA
    # as for corners that err by at least 0.1 `_CORNER_SIGMA`
    sigma = max(scale, 0.1) * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    posed = []
    for k, (name, error) in enumerate(zip(boards, errors, strict=True)):
        rms_px = float(np.sqrt(2 * np.mean(error**2)))  # of the distance in x and y
        sigma_deg = float(np.degrees(sigma[_of_view(k)][:3].max()))
        posed.append(PosedView(name, _pose(found.x[_of_view(k)]), len(error), rms_px, sigma_deg))
    return _camera(capture, found.x, float(sigma[0])), posed
