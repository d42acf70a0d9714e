"""Blur of a view from the edges of the board: a Gaussian of known width."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from polcap.fusion.poses import SessionCamera
from polcap.image_values import Floats
from polcap.material import board_focus
from polcap.material.board_focus import BoardSight
from polcap.material.stokes_view import PosedStokes
from polcap.quality import flat_sample
from polcap.quality.limits import MaterialGateLimits
from polcap.stage_values import StokesImage
from tests.fusion.board_views import BOARD, COLOR, FOCAL, VIEW, picture, pose, scene


def seen(s0: Floats) -> PosedStokes:
    """A view of S0 (H, W, 3) as the Stokes stage gives it."""
    zero = np.zeros((*s0.shape[:2], 3), np.float32)
    stokes = StokesImage(
        np.stack([s0.astype(np.float32), zero, zero]), np.zeros((6, *zero.shape), np.float32),
        np.zeros(zero.shape[:2], np.uint8), np.ones(zero.shape[:2], bool), VIEW, None,
    )  # fmt: skip
    camera = SessionCamera(FOCAL, 0.0, VIEW.center, 0.0, 0.0)
    return PosedStokes("view01", stokes, np.radians([0.0, 45, 90]), np.asarray(COLOR.matrix), pose(10.0, 60.0), camera)


def test_blur_of_the_board_is_measured_and_a_blurred_view_is_named() -> None:
    sharp = seen(picture(scene(pose(10.0, 60.0))))
    blurred = replace(sharp, stokes=seen(gaussian_filter(np.asarray(sharp.stokes.stokes[0]), (1.5, 1.5, 0))).stokes)
    first, second = board_focus.measure((sharp, blurred), BOARD).blur
    assert first < 0.6
    assert np.sqrt(second**2 - first**2) == pytest.approx(1.5, rel=0.15)
    sight = BoardSight((first, second, first), (900, 900, 12))
    named = board_focus.left_out(("view01", "view02", "view03"), sight)
    assert "out of focus" in named["view02"] and "12 points" in named["view03"] and "view01" not in named


def test_a_view_less_sharp_than_the_others_is_named() -> None:
    blur = {"view01": 0.52, "view02": 0.48, "view03": 0.76}  # px, of five simulated views; 1.5 RAW px for the third
    gate = flat_sample.focus(blur, MaterialGateLimits())
    assert gate.state == "warn" and gate.value == pytest.approx(0.555, abs=0.01)
    assert "view03: less sharp than the median view" in gate.message and "view03 again" in gate.remedy
    assert flat_sample.focus({**blur, "view03": 0.5}, MaterialGateLimits()).state == "pass"
    assert flat_sample.focus({"view01": float("nan")}, MaterialGateLimits()).state == "not measured"
