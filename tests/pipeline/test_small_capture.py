"""Where things lie on the pictures that `check` judges: a pixel stands for a block of RAW pixels."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.images import ChartRequest
from polcap.pipeline import small_capture as reduced
from polcap.pipeline import small_capture_run as judge
from polcap.stages import whitebalance


def test_the_middle_of_the_picture_stays_its_middle(example: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reduced, "_MOST_PIXELS", 0.07e6)  # of 0.25 million
    with ThreadPoolExecutor(1) as pool:
        taken = reduced.take(captures.read(example), 0.98, pool)
    found, (width, height) = taken.capture, taken.capture.size_px
    assert taken.step == 4 and (width * taken.step, height * taken.step) == (1152, 864)
    assert found.principal_px == pytest.approx(((width - 1) / 2, (height - 1) / 2))
    assert found.focal_px * taken.step == pytest.approx(84 / 36 * 1152)


def test_corners_of_the_chart_are_asked_for_where_they_were_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The outer edges of a block of RAW pixels are the outer edges of the pixel that stands for it."""
    monkeypatch.setattr(whitebalance, "measure", lambda radiance, reference, request, settings: request)
    edges = np.array([[-0.5, -0.5], [39.5, -0.5], [39.5, 23.5], [-0.5, 23.5]])
    taken = SimpleNamespace(step=4, binned=2, capture=SimpleNamespace(shots=(), focal_doubt=(0.0, 0.0)))
    request, pool = ChartRequest("corners", corners=edges), ThreadPoolExecutor(1)
    small = judge.Reduced(taken, lambda: (None, None), Config(), request, pool)  # type: ignore[arg-type]  # a stand-in
    monkeypatch.setattr(judge.Reduced, "radiance", None)
    np.testing.assert_allclose(small.color.corners, [[-0.5, -0.5], [9.5, -0.5], [9.5, 5.5], [-0.5, 5.5]])
