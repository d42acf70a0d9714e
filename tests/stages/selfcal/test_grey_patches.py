"""Grey patches give the gains within their error; gloss shows on the dark ones; hidden ones do not count."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polcap.chart_values import ChartPlace, ColorCalibration, PatchColors
from polcap.image_values import Bits
from polcap.quality import shot_exposure
from polcap.quality.gate_values import Gate
from polcap.quality.limits import GateLimits
from polcap.stage_values import SelfCalibration
from polcap.stages.selfcal import grey_patches
from polcap.stages.whitebalance.patches import PatchUse
from tests import scenes
from tests.stages.selfcal.shapes import solve

GAIN = np.array([1.0, 1.013, 0.981])
SHOTS = scenes.stack(gain=GAIN, noise=0.004)
GREYS = np.arange(24) >= 18


def board(use: Bits | None = None) -> ColorCalibration:
    """24 squares on the scene's unpolarized board, as a chart's patches."""
    quads = []
    for row in range(4):
        for column in range(6):
            x, y = 230 + 11 * column, 36 + 38 * row
            quads.append([[x, y], [x + 9, y], [x + 9, y + 30], [x, y + 30]])
    place = ChartPlace(np.array(quads, float), np.zeros((4, 2)))
    return replace(scenes.no_color(), place=place, source="chart", patches=PatchColors(np.zeros(24), use))


def test_grey_patches_give_the_gains_within_their_error():
    found = solve(SHOTS, board()).gains
    assert found.source == "grey patches"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.002
    z = (found.gain[1:] - GAIN[1:, None]) / found.sigma[1:]
    assert np.abs(z).max() < 4


@pytest.mark.parametrize("reason", [PatchUse.UNEVEN, PatchUse.ODD])
def test_hidden_grey_patches_do_not_count(reason):
    """A cloth over the grey row, brighter in one shot: the gains come from the patches that serve, or the object."""
    value = SHOTS.value.copy()
    value[:, 150:190, 224:300] = 0.02 * np.random.default_rng(1).uniform(0.5, 1.5, size=(3, 40, 76, 1))
    covered = replace(SHOTS, value=value)
    use = np.where(GREYS, reason, PatchUse.USED).astype(np.uint8)
    found = solve(covered, board(use)).gains
    assert found.source == "object"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.005
    use[[18, 19]] = PatchUse.USED  # white and neutral 8 show: they alone serve
    value[:, 150:190, 230:252] = SHOTS.value[:, 150:190, 230:252]
    half = solve(replace(SHOTS, value=value), board(use)).gains
    assert half.source == "grey patches" and np.isnan(half.grey_slope)
    assert np.abs(half.gain.mean(1) / GAIN - 1).max() < 0.003


def test_a_chart_that_moved_gives_no_gains():
    """In one shot other parts of the chart are where the grey row was: the object gives the gains."""
    value = SHOTS.value.copy()
    for column, times in enumerate([0.04, 0.03, 0.1, 0.2, 0.5, 1.0]):
        value[1, 150:190, 230 + 11 * column : 241 + 11 * column] *= times
    moved = solve(replace(SHOTS, value=value), board())
    assert moved.gains.source == "object"
    assert np.abs(moved.gains.gain.mean(1) / GAIN - 1).max() < 0.005
    gains = replace(moved.gains, sigma=np.full((3, 3), 0.01))
    gate = gain_doubt(replace(moved, gains=gains), color=board(), radiance=SHOTS, object_=scenes.ball_object())
    assert gate.state == "warn" and "moved" in gate.message and "Fix the chart" in gate.remedy


def test_strong_gloss_does_not_look_like_a_chart_that_moved():
    """A gloss of 6 % of the white patch, polarized to two fifths."""
    value = SHOTS.value.copy()
    value[:, 30:190, 224:300] += 0.06 * (0.6 + 0.4 * np.array([1.0, 0.0, -1.0]))[:, None, None, None]
    assert solve(replace(SHOTS, value=value), board()).gains.source == "grey patches"


def test_grey_patches_with_a_large_error_are_doubted():
    """Their distance from the object's gains is then within the error of both: the error itself is judged."""
    found = solve(SHOTS, board())
    gains = replace(found.gains, gain=found.gains.gain * [[1], [1.11], [1.13]], sigma=np.full((3, 3), 0.31))
    gate = gain_doubt(replace(found, gains=replace(gains, disagreement=0.0)))
    assert gate.state == "fail" and gate.value == pytest.approx(0.31) and gate.limit == GateLimits().max_gain_doubt
    assert gain_doubt(found).state == "pass"


def gain_doubt(found: SelfCalibration, **results: Any) -> Gate:
    seen: Any = SimpleNamespace(results=SimpleNamespace(selfcal=found, **results), names=["0°", "45°", "90°"])
    return shot_exposure.gain_doubt(seen, GateLimits())


def test_a_polarized_chart_disagrees_with_the_object():
    radiance = scenes.stack(noise=0.002)
    value = radiance.value.copy()
    value[2, :, 224:300] *= 1.05  # as a chart turned away would
    assert solve(replace(radiance, value=value), board()).gains.disagreement > 0.02
    assert solve(radiance, board()).gains.disagreement < 1e-4


def test_gloss_on_the_chart_shows_on_its_dark_patches():
    value, variance = np.ones((3, 6)) * (0.9, 0.6, 0.36, 0.2, 0.09, 0.03), np.full((3, 6), 1e-8)
    assert grey_patches._gloss(value * GAIN[:, None], variance) == 0
    value[1] += 0.02  # the same light on dark and light ones, in one shot
    assert grey_patches._gloss(value, variance) == pytest.approx(0.02 / 0.9, rel=0.3)
