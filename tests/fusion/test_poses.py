"""Poses from the board: one camera, errors as large as they say, and every fault has a name."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.errors import CaptureError
from polcap.fusion import board_corners, poses
from polcap.fusion.board_corners import BoardCorners
from polcap.fusion.poses import SessionPoses
from polcap.optics import projection
from tests.fusion import board_views
from tests.fusion.board_views import COLOR, FOCAL, VIEW

BEND = (-0.15, 0.3)
TRUE = {f"view{k + 1:02d}": board_views.pose(60 * k + 3, shift=(0.004, -0.003)) for k in range(6)}
ON_OBJECT = np.array([[0, 0.06, 0], [0.03, 0.03, 0], [0, 0.03, 0.03], [-0.03, 0.03, 0]])


def seen(value: np.ndarray) -> BoardCorners:
    found = board_corners.detect(board_views.stack(value), COLOR).corners
    assert found is not None
    return found


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    return {name: board_views.picture(board_views.scene(at), BEND) for name, at in TRUE.items()}


@pytest.fixture(scope="module")
def corners(pictures: dict[str, np.ndarray]) -> dict[str, BoardCorners]:
    return {name: seen(value) for name, value in pictures.items()}


@pytest.fixture(scope="module")
def solved(corners: dict[str, BoardCorners]) -> SessionPoses:
    return poses.solve(corners, board_views.capture(1.03 * FOCAL))


def test_the_object_projects_to_its_true_pixels(solved: SessionPoses) -> None:
    for name, at in TRUE.items():
        true = distorted(projection.project(VIEW, ON_OBJECT @ at.rotation.T + at.translation))
        assert np.abs(solved.camera.project(solved.views[name].pose, ON_OBJECT) - true).max() < 0.15, name


def distorted(pixel: np.ndarray) -> np.ndarray:
    x = (pixel - np.array(VIEW.center)) / FOCAL
    r2 = (x**2).sum(axis=1, keepdims=True)
    return np.asarray(np.array(VIEW.center) + FOCAL * x * (1 + BEND[0] * r2 + BEND[1] * r2**2))


def test_residuals_are_far_below_a_pixel(solved: SessionPoses) -> None:
    assert not solved.left_out
    assert all(0.001 < view.residual_px < 0.1 for view in solved.views.values())


def test_the_focal_length_is_known_as_well_as_stated(solved: SessionPoses) -> None:
    assert abs(solved.camera.focal_px - FOCAL) < 4 * solved.camera.focal_sigma_px
    assert solved.camera.focal_sigma_px < 0.01 * FOCAL


def test_rotations_err_as_much_as_their_sigma_says(solved: SessionPoses) -> None:
    ratio = []
    for name, at in TRUE.items():
        turn = Rotation.from_matrix(solved.views[name].pose.rotation @ at.rotation.T)
        ratio.append(np.degrees(turn.magnitude()) / solved.views[name].sigma_deg)
    assert 0.05 < np.sqrt(np.mean(np.square(ratio))) < 3


def test_the_world_frame_has_y_up_and_the_lens_above_the_board(solved: SessionPoses) -> None:
    for view in solved.views.values():
        assert np.linalg.det(view.pose.rotation) == pytest.approx(1)
        x, y, z = view.pose.center
        assert np.degrees(np.arctan2(y, np.hypot(x, z))) == pytest.approx(28, abs=2)


def test_a_half_hidden_board_is_enough(pictures: dict[str, np.ndarray], corners: dict[str, BoardCorners]) -> None:
    half = pictures["view01"].copy()
    half[:, : half.shape[1] // 2] = 0.02
    some = {**corners, "view01": seen(half)}
    assert 6 <= len(some["view01"].number) < 0.7 * len(corners["view01"].number)
    assert poses.solve(some, board_views.capture()).views["view01"].residual_px < 0.1


def test_a_view_without_board_is_recognized(pictures: dict[str, np.ndarray]) -> None:
    found = board_corners.detect(board_views.stack(0 * pictures["view05"] + 0.02), COLOR)
    assert found.corners is None and "no board is visible (0 of its markers, 3 are needed)" in found.missing


def test_too_few_corners_are_named(pictures: dict[str, np.ndarray]) -> None:
    part = pictures["view02"].copy()
    part[:, : int(0.7 * part.shape[1])] = 0.02
    with pytest.raises(CaptureError, match=r"\d of 24 corners of the board are visible, 6 are needed"):
        seen(part)


def test_two_boards_in_view_are_named(pictures: dict[str, np.ndarray]) -> None:
    small = board_views.picture(board_views.scene(board_views.pose(10), size="A3"))
    with pytest.raises(CaptureError, match="two boards are visible"):
        seen(np.concatenate([pictures["view01"], pictures["view02"]], axis=1))
    with pytest.raises(CaptureError, match=r"two boards are visible \(A4 and A3\)"):
        seen(np.concatenate([pictures["view01"], small], axis=1))


def test_a_bent_board_is_left_out(corners: dict[str, BoardCorners]) -> None:
    other = corners["view04"]
    bent = replace(other, measured_px=other.measured_px + np.array([0.0, 6.0]) * np.abs(other.world[:, :1]) / 0.072)
    found = poses.solve({**corners, "view04": bent}, board_views.capture())
    assert list(found.left_out) == ["view04"]
    assert "its corners are" in found.left_out["view04"]
    assert all(view.residual_px < 0.1 for view in found.views.values())


def test_two_views_are_refused(corners: dict[str, BoardCorners]) -> None:
    with pytest.raises(CaptureError, match="2 views can be posed, 3 are needed"):
        poses.solve({name: corners[name] for name in ("view01", "view02")}, board_views.capture())
