"""Figures of maps leave out values that could not be measured."""

from base64 import b64decode
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from polcap.report import map_figures


def test_colors_beyond_the_outline_are_hidden_by_a_mask() -> None:
    inside = np.zeros((9, 9), bool)
    inside[3:6, 3:6] = True
    figure = map_figures.normal("normal", "Normal", np.dstack([np.zeros((9, 9, 2)), np.ones((9, 9))]), inside)
    opaque = cv2.imdecode(
        np.frombuffer(b64decode(figure.outline.partition("base64,")[2]), np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert np.array_equal(opaque[..., 3] > 0, inside)


def test_a_difference_that_was_not_measured_has_no_number() -> None:
    nothing = np.zeros((4, 5))
    small: Any = SimpleNamespace(angle=np.zeros(1), maps=SimpleNamespace(mask=nothing > 0))  # of a very thin object
    again: Any = SimpleNamespace(measured=[nothing], predicted=[nothing])
    (figure,) = map_figures.differences(small, again, {"rms": [None], "outliers": [None]})
    assert (figure.title, figure.note) == ("Polarizer at 0°", "")
