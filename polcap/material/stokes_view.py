"""Stages of one view of a flat sample: the path of a single capture up to its Stokes parameters, without networks.

The board is searched first. The poses then give the part of the picture that shows the board. It is used as the mask.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from polcap.config import Config
from polcap.fusion.poses import SessionCamera
from polcap.fusion.values import Pose
from polcap.fusion.view_path import SessionView
from polcap.image_values import Bools, Floats
from polcap.optics.board import Board
from polcap.optics.projection import to_grid
from polcap.pipeline import path as single
from polcap.pipeline import run
from polcap.pipeline.cache import LazyCache, value_of
from polcap.stage_values import StokesImage


@dataclass(frozen=True)
class PosedStokes:
    """Stokes parameters of a view, with its pose and camera."""

    name: str
    stokes: StokesImage
    angle: Floats  # (A,) rad, of the polarizer
    matrix: Floats  # (3, 3) camera radiance to linear Rec.709
    pose: Pose
    camera: SessionCamera

    def pixels(self, point: Floats) -> tuple[Floats, Floats]:
        """Pixels x, y of the Stokes image that show world points (..., 3) [m]."""
        raw = self.camera.project(self.pose, point.reshape(-1, 3)).reshape(*point.shape[:-1], 2)
        view = self.stokes.view
        x, y = (to_grid(raw[..., k], view.scale) - view.origin[k] for k in (0, 1))
        return x, y


def of_flat_views(config: Config) -> Config:
    """The settings of the views of a flat sample: the outline gives no order and no zero of angles; no undistortion."""
    selfcal = msgspec.structs.replace(config.selfcal, check_order=False, correct_ring=False)
    stokes = msgspec.structs.replace(config.stokes, undistort=False)
    return msgspec.structs.replace(config, selfcal=selfcal, stokes=stokes)


def board_mask(size_px: Sequence[int], camera: SessionCamera, pose: Pose, board: Board) -> Bools:
    """Part (H, W) of a view's visible RAW picture that shows the board's page."""
    half = board.page_m[0] / 2
    corners = np.array([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]])
    mask = np.zeros(tuple(size_px)[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.rint(camera.project(pose, corners)).astype(np.int32), 1)
    return mask > 0


def solve(view: SessionView) -> str:
    """Compute the Stokes parameters of a view whose supplied mask shows the board; returns their key.

    Raises AlignmentError, CaptureError: as the stages.
    """
    cache = LazyCache(view.out)
    with run.opened(view.capture, view.supplied, view.config, cache):
        single.run_stages(view.capture, view.supplied, view.config, cache)
        found = cache.results["stokes"]
        value_of(found)  # makes and stores it
        return found.key
