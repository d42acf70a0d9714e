"""The board's print vanishes from a view, and the object in front of it stays."""

import numpy as np
import pytest
from msgspec import UNSET
from msgspec.structs import replace

from polcap.fusion import board_eraser
from polcap.fusion.board_eraser import PosedBoard
from polcap.fusion.poses import SessionCamera
from polcap.image_values import Bools, Floats
from polcap.optics.morphology import dilate
from polcap.stage_values import Alignment
from polcap.synth import render
from polcap.synth.scene_materials import Coat, Material
from tests.fusion import board_views
from tests.fusion.board_views import BOARD, COLOR, FOCAL, HEIGHT, VIEW, WIDTH

CAMERA = SessionCamera(FOCAL, 1.0, VIEW.center, 0.0, 0.0)
STILL = Alignment(np.repeat(np.eye(3)[None], 2, axis=0), np.zeros(2), np.ones(2))


def erased(albedo: tuple[float, float, float]) -> tuple[Floats, Floats, Bools]:
    """S0 (H, W, 3) before and after, and the true mask (H, W), of a ball that hides a part of the ring."""
    at = board_views.pose(20)
    coat = Coat((Material(albedo, albedo, "plain", roughness=(0.5, 0.5)),))
    scene = replace(board_views.scene(at, shift=np.array([0.03, 0.0, -0.02])), coat=coat)
    before = board_views.picture(scene)
    after = board_eraser.erase(board_views.stack(before), STILL, COLOR, PosedBoard(BOARD, CAMERA, at))
    return before, 2 * np.asarray(after.value[0]), render.gbuffer(scene, VIEW, HEIGHT, WIDTH).mask


@pytest.mark.parametrize("albedo", [(0.6, 0.5, 0.4), (0.8, 0.8, 0.8), (0.2, 0.2, 0.25)])
def test_the_print_becomes_dark_and_the_object_stays(albedo: tuple[float, float, float]) -> None:
    before, after, mask = erased(albedo)
    bright = ~mask & (before.mean(axis=-1) > 0.2)
    assert bright.sum() > 10000
    assert (after[bright].mean(axis=-1) < 0.1).mean() > 0.97
    changed = np.abs(after - before).max(axis=-1) > 1e-3
    assert changed[mask].mean() < 0.04
    around = dilate(mask, 4) & bright
    assert around.sum() > 200
    assert changed[around].mean() > 0.98  # the part that stays is not shifted against the object


def test_the_print_becomes_dark_under_warm_light_and_a_quarter_of_a_pixel_aside() -> None:
    """The pose may err by this much, and without a chart the print is not grey."""
    at = board_views.pose(20)
    scene = board_views.scene(at)
    before = board_views.picture(scene) * [1.3, 1.0, 0.6]
    shifted = SessionCamera(FOCAL, 1.0, (VIEW.center[0] + 0.25, VIEW.center[1] - 0.25), 0.0, 0.0)
    after = board_eraser.erase(board_views.stack(before), STILL, COLOR, PosedBoard(BOARD, shifted, at))
    bright = ~render.gbuffer(scene, VIEW, HEIGHT, WIDTH).mask & (before.mean(axis=-1) > 0.2)
    assert (2 * np.asarray(after.value[0])[bright].mean(axis=-1) < 0.1).mean() > 0.97


def test_a_picture_that_shows_no_board_does_not_change() -> None:
    at = board_views.pose(0)
    stack = board_views.stack(board_views.picture(replace(board_views.scene(at), board=UNSET)))
    away = board_views.pose(0, shift=(5.0, 0.0))
    same = board_eraser.erase(stack, STILL, COLOR, PosedBoard(BOARD, CAMERA, away))
    assert np.array_equal(same.value, stack.value)
