"""The object's mask."""

import dataclasses

import numpy as np
import pytest

from polcap.errors import ObjectError
from polcap.stages import mask
from tests import scenes


def segment(radiance, color, user=None):
    return mask.segment(radiance, scenes.still(), color, user, mask.Settings())


def chart_color():
    corners = np.array([[223, 29], [301, 29], [301, 201], [223, 201]], float)
    return dataclasses.replace(scenes.no_color(), corners=corners, source="chart")


def test_the_ball_is_found_and_the_chart_is_not_the_object():
    found = segment(scenes.stack(noise=0.004), chart_color())
    true = scenes.ball_object().mask
    overlap = (found.mask & true).sum() / (found.mask | true).sum()
    assert overlap > 0.97
    assert not found.mask[:, 224:].any()
    assert found.crop[0] < 36 and found.crop[2] > 204


def test_a_drawn_mask_is_taken_as_drawn():
    drawn = np.zeros((scenes.HEIGHT, scenes.WIDTH), bool)
    drawn[50:100, 60:130] = True
    found = segment(scenes.stack(), chart_color(), drawn)
    assert np.array_equal(found.mask, drawn) and found.source == "user"


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ObjectError, match="10×10 px"):
        segment(scenes.stack(), chart_color(), np.ones((10, 10), bool))


def test_an_empty_picture_is_refused():
    radiance = scenes.stack()
    dark = dataclasses.replace(radiance, value=np.full_like(radiance.value, 0.002))
    with pytest.raises(ObjectError, match="no object stands out"):
        segment(dark, chart_color())
