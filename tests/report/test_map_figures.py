"""Figures of maps leave out values that could not be measured."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from polcap.report import map_figures


def test_an_object_too_thin_for_the_page_leaves_its_figures_out() -> None:
    nothing = np.zeros((4, 5))
    small: Any = SimpleNamespace(angle=np.zeros(1), maps=SimpleNamespace(mask=nothing > 0))  # all that is read of it
    again: Any = SimpleNamespace(measured=[nothing], predicted=[nothing])
    section = "".join(map_figures.rerendered(small, again, {"figures": {"rerendering": {"rms": [None]}}}))
    assert "Polarizer at 0°" in section and "rms" not in section
