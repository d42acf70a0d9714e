"""Where things lie on the pictures that `check` judges: a pixel stands for a block of RAW pixels."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from polcap.formats.capture import reader as captures
from polcap.images import ChartRequest
from polcap.pipeline import check, small_capture


def test_the_middle_of_the_picture_stays_its_middle(example: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(small_capture, "_MOST_PIXELS", 0.07e6)  # of 0.25 million
    with ThreadPoolExecutor(1) as pool:
        taken = small_capture.reduce(captures.read(example), 0.98, pool)
    found, (width, height) = taken.capture, taken.capture.size_px
    assert taken.step == 4 and (width * taken.step, height * taken.step) == (1152, 864)
    assert found.principal_px == pytest.approx(((width - 1) / 2, (height - 1) / 2))
    assert found.focal_px * taken.step == pytest.approx(84 / 36 * 1152)


def test_corners_of_the_chart_are_asked_for_where_they_were_seen() -> None:
    """The outer edges of a block of RAW pixels are the outer edges of the pixel that stands for it."""
    edges = np.array([[-0.5, -0.5], [39.5, -0.5], [39.5, 23.5], [-0.5, 23.5]])
    moved = check._moved(ChartRequest("corners", corners=edges), 4)
    np.testing.assert_allclose(moved.corners, [[-0.5, -0.5], [9.5, -0.5], [9.5, 5.5], [-0.5, 5.5]])
