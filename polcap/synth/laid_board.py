"""Simulated board under the object: a flat print, matt or glossy, cut to a square as wide as its page."""

from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polcap.image_values import Floats
from polcap.optics import board as boards

_PAPER, _INK = 0.8, 0.03  # albedos, unpolarized
F0, IOR = 0.04, 1.5  # of a glossy print


class LaidBoard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of a board in the camera frame: camera point = turn (world point) + position."""

    position: tuple[float, float, float]  # m, of the board's middle
    turn_deg: tuple[float, float, float]  # rotation vector, world to camera
    size: Literal["A4", "A3", "A2"] = "A4"
    roughness: float | UnsetType = UNSET  # of a glossy print; unset: matt

    @property
    def turn(self) -> Rotation:
        return Rotation.from_rotvec(self.turn_deg, degrees=True)

    @property
    def normal(self) -> Floats:
        """Unit vector (3,) up out of the board, camera frame."""
        return np.asarray(self.turn.apply([0.0, 1.0, 0.0]))


def intersect(laid: LaidBoard, v: Floats) -> tuple[NDArray[np.integer], Floats, Floats]:
    """Intersect rays with the printed side of the paper.

    Indices (N,) of the rays v (P, 3), surface to camera, that hit it, lengths (N,) [m] and albedo (N, 3).
    """
    board, normal = boards.BOARDS[laid.size], laid.normal
    towards = np.flatnonzero(v @ normal > 1e-3)
    distance = -(np.array(laid.position) @ normal) / (v[towards] @ normal)
    world = laid.turn.inv().apply(-v[towards] * distance[:, None] - laid.position)
    x, z = world[:, 0], world[:, 2]
    on = (np.maximum(np.abs(x), np.abs(z)) < board.page_m[0] / 2) & (distance > 0)
    albedo = np.where(boards.is_ink(board, x[on], z[on]), _INK, _PAPER)
    return towards[on], distance[on], np.repeat(albedo[:, None], 3, axis=1)
