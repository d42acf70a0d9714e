"""Angles that nobody noted are found of five shots, or the run ends with a line that says what is missing."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.images import Equipment
from polcap.optics.outline import Rim
from polcap.stages import selfcal, stokes
from polcap.stages.selfcal import unknown_angles
from tests import scenes

TRUE = np.radians([12.0, 51.0, 83.0, 118.0, 160.0])
NAMES = np.radians([0.0, 1.0, 2.0, 3.0, 4.0])
SHOTS = scenes.stack(angles=TRUE)


def found(shots=5, light="one exposure", **settings):
    radiance = replace(
        SHOTS, value=SHOTS.value[:shots], variance=SHOTS.variance[:shots], quality=SHOTS.quality[:shots],
        angle=NAMES[:shots], equipment=Equipment(light),
    )  # fmt: skip
    chosen = selfcal.Settings(unknown_angles=True, **settings)
    return radiance, selfcal.solve(radiance, scenes.still(shots), scenes.ball_object(), scenes.no_color(), chosen)


def test_five_angles_of_a_ball_are_found():
    radiance, gains = found()
    apart = (gains.found_angle + gains.angle_correction - TRUE + np.pi / 2) % np.pi - np.pi / 2
    assert np.degrees(np.abs(apart)).max() < 1.5
    assert np.degrees(np.abs(apart)).max() < 3.5 * max(np.degrees(gains.found_sigma), 0.3)
    solved = stokes.solve(radiance, scenes.still(5), gains, scenes.ball_object(), stokes.Settings())
    true = replace(gains, found_angle=TRUE, angle_correction=0.0)
    expected = stokes.solve(radiance, scenes.still(5), true, scenes.ball_object(), stokes.Settings())
    off = solved.stokes[1:] - expected.stokes[1:]
    assert np.abs(off[:, solved.mask]).mean() < 0.08 * np.abs(expected.stokes[1:][:, solved.mask]).mean()


def test_three_shots_are_refused():
    with pytest.raises(CaptureError, match="3 shots at unknown angles: four are needed"):
        found(3)


def test_gains_that_nobody_knows_are_refused():
    with pytest.raises(CaptureError, match="put a color chart beside the object"):
        found(light="unknown")


def test_angles_that_are_hardly_told_are_refused():
    with pytest.raises(CaptureError, match="tell the polarizer's angles to"):
        found(max_unknown_sigma_deg=0.01)


def test_an_outline_that_says_nothing_leaves_them_unknown():
    rim = Rim(np.zeros((4, 0)), np.zeros(0), np.zeros(0, int))
    assert unknown_angles.measure(rim, np.ones((4, 100)), np.zeros(100, int), 4).sigma == np.pi / 2
