"""Figures of maps leave out values that could not be measured."""

from base64 import b64decode
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from polcap.report import map_figures


def test_colors_beyond_the_outline_are_hidden_by_a_mask() -> None:
    inside = np.zeros((15, 15), bool)
    inside[3:12, 3:12] = True
    figure = map_figures.normal("normal", "Normal", np.dstack([np.zeros((15, 15, 2)), np.ones((15, 15))]), inside)
    opaque = cv2.imdecode(
        np.frombuffer(b64decode(figure.outline.partition("base64,")[2]), np.uint8), cv2.IMREAD_UNCHANGED
    )[..., 3]
    assert (opaque[5:10, 5:10] == 255).all() and (opaque[0] == 0).all()
    assert 0 < opaque[3, 3] < 255  # corners are round


def test_a_difference_that_was_not_measured_has_no_number() -> None:
    nothing = np.zeros((4, 5))
    small: Any = SimpleNamespace(angle=np.zeros(1), maps=SimpleNamespace(mask=nothing > 0))  # of a very thin object
    again: Any = SimpleNamespace(measured=[nothing], predicted=[nothing])
    (figure,) = map_figures.differences(small, again, {"rms": [None], "outliers": [None]})
    assert (figure.title, figure.note) == ("Polarizer at 0°", "")
