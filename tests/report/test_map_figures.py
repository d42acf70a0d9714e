"""Figures of maps leave out values that could not be measured."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from polcap.report import map_figures


def test_a_difference_that_was_not_measured_has_no_number() -> None:
    nothing = np.zeros((4, 5))
    small: Any = SimpleNamespace(angle=np.zeros(1), maps=SimpleNamespace(mask=nothing > 0))  # of a very thin object
    again: Any = SimpleNamespace(measured=[nothing], predicted=[nothing])
    (figure,) = map_figures.differences(small, again, [None])
    assert (figure.title, figure.note) == ("Polarizer at 0°", "")
