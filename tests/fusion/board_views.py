"""Rendered pictures of a board with an object on it, as the values that `fusion` reads."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from polcap.capture_values import Capture
from polcap.chart_values import ColorCalibration
from polcap.fusion.values import Pose
from polcap.image_values import Floats, View
from polcap.optics import board as boards
from polcap.stage_values import AngleStack, single_frames
from polcap.synth import forward_camera, render
from polcap.synth.distance_fields import Cluster
from polcap.synth.laid_board import LaidBoard
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material

WIDTH, HEIGHT, FOCAL = 720, 540, 1520.0
VIEW = View(FOCAL, ((WIDTH - 1) / 2, (HEIGHT - 1) / 2), 1.0)
COLOR = ColorCalibration(np.eye(3), "none")
BALL = Cluster(((0, 0, 0, 0.03),))
PALE = Coat((Material((0.6, 0.5, 0.4), (0.6, 0.5, 0.4), "plain", roughness=(0.5, 0.5)),))
BOARD = boards.BOARDS["A4"]


def pose(degrees: float, elevation: float = 28.0, shift: tuple[float, float] = (0.0, 0.0)) -> Pose:
    """A board turned by `degrees` and moved by `shift` [m, x and z of the table]."""
    tilt = Rotation.from_euler("x", elevation, degrees=True)
    turn = tilt * Rotation.from_euler("y", degrees, degrees=True)
    return Pose(turn.as_matrix(), tilt.apply([shift[0], -0.02, shift[1]]) - [0.0, 0.0, 0.7])


def scene(at: Pose, shape: Cluster = BALL, size: Any = "A4", shift: Floats | None = None) -> Scene:
    """A shape whose lowest point rests on the board, moved by `shift` (3,) [m] on it."""
    place = np.array([0.0, 0.03, 0.0]) if shift is None else np.array([0.0, 0.03, 0.0]) + shift
    vector = tuple(Rotation.from_matrix(at.rotation).as_rotvec(degrees=True).tolist())
    return Scene(
        shape=shape, coat=PALE, position=tuple((at.rotation @ place + at.translation).tolist()), turn_deg=vector,
        chart=None, board=LaidBoard(tuple(at.translation.tolist()), vector, size), cast_shadows=True,
    )  # fmt: skip


def picture(seen: Scene, bend: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """S0 (H, W, 3) with two rays per pixel and noise of 1 % of white."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    total: Floats = np.zeros((HEIGHT, WIDTH, 3))
    for off in (-0.25, 0.25):
        total += render.stokes(seen, VIEW, *forward_camera.undistort(VIEW, bend, x + off, y - off))[0] / 2
    return total + 0.005 * np.random.default_rng(0).normal(size=total.shape)


def stack(value: Floats) -> AngleStack:
    """A merged capture of two equal shots of S0 `value`, through unpolarized light."""
    shots = np.repeat(0.5 * value[None], 2, axis=0).astype(np.float32)
    return AngleStack(
        shots, np.full_like(shots, 1e-6), np.zeros(shots.shape[:3], np.uint8), np.radians([0.0, 90.0]), VIEW,
        single_frames(2),
    )  # fmt: skip


def capture(focal_px: float = FOCAL) -> Capture:
    """Facts of the camera that took the pictures, with a stated focal length."""
    return Capture("view01", ".", (), "folders", focal_px, True, VIEW.center, (WIDTH, HEIGHT))
