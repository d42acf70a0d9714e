"""Per-shot gains, and the outline's word on the order of the angles."""

import dataclasses

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.stages import selfcal
from tests import scenes

GAIN = np.array([1.0, 1.013, 0.981])


def board_quads() -> np.ndarray:
    """24 squares on the scene's unpolarized board, standing for a chart's patches."""
    quads = []
    for row in range(4):
        for column in range(6):
            x, y = 230 + 11 * column, 36 + 38 * row
            quads.append([[x, y], [x + 9, y], [x + 9, y + 30], [x, y + 30]])
    return np.array(quads, float)


def solve(radiance, color, **settings):
    return selfcal.solve(radiance, scenes.still(), scenes.ball_object(), color, selfcal.Settings(**settings))


def test_grey_patches_give_the_gains_within_their_error():
    color = dataclasses.replace(scenes.no_color(), quads=board_quads(), source="chart")
    found = solve(scenes.stack(gain=GAIN, noise=0.004), color)
    assert found.source == "grey patches"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.002
    z = (found.gain[1:] - GAIN[1:, None]) / found.sigma[1:]
    assert np.abs(z).max() < 4


def test_without_a_chart_the_facing_pixels_serve():
    found = solve(scenes.stack(gain=GAIN, noise=0.004), scenes.no_color())
    assert found.source == "facing pixels"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.005


def test_a_polarized_chart_disagrees_with_the_object():
    radiance = scenes.stack(noise=0.002)
    value = radiance.value.copy()
    value[2, :, 224:300] *= 1.02  # as a glossy or tilted chart would
    color = dataclasses.replace(scenes.no_color(), quads=board_quads(), source="chart")
    assert solve(dataclasses.replace(radiance, value=value), color).disagreement > 0.003
    assert solve(radiance, color).disagreement < 0.003


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1)])
def test_swapped_shots_are_refused_with_the_order_that_fits(order):
    radiance = scenes.stack(noise=0.002)
    swapped = dataclasses.replace(radiance, value=radiance.value[list(order)])
    names = ", ".join(f"{np.degrees(radiance.angle[i]):g}°" for i in order)
    with pytest.raises(CaptureError, match=f"it supports {names} "):
        solve(swapped, scenes.no_color())


def test_angles_counted_clockwise_are_refused():
    radiance = scenes.stack(noise=0.002, angles=np.radians([0.0, 60.0, 120.0]))
    mirrored = dataclasses.replace(radiance, angle=np.radians([0.0, -60.0, -120.0]))
    with pytest.raises(CaptureError, match="outline"):
        solve(mirrored, scenes.no_color())


def test_the_turn_of_the_ring_is_measured():
    radiance = scenes.stack(noise=0.002, angles=np.radians([7.0, 52.0, 97.0]))
    clocked = dataclasses.replace(radiance, angle=np.radians([0.0, 45.0, 90.0]))
    found = solve(clocked, scenes.no_color())
    assert np.degrees(found.angle_offset) == pytest.approx(-7, abs=max(0.5, 3 * np.degrees(found.angle_offset_sigma)))
    assert np.degrees(found.angle_offset_sigma) < 2


def test_the_check_can_be_left_out():
    radiance = scenes.stack(noise=0.002)
    swapped = dataclasses.replace(radiance, value=radiance.value[[2, 1, 0]])
    assert solve(swapped, scenes.no_color(), check_order=False).order == (2, 1, 0)
