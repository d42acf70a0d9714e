"""Memory bounds how many frames are held, never what comes out."""

import weakref
from dataclasses import replace

import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.errors import SettingError
from polcap.stages.hdr import planes
from tests.stages.hdr.brackets import PicturedFrame, capture, expose, frame, merge, ramp


def test_little_memory_gives_the_same_pixels_and_less_is_refused_by_its_least(monkeypatch):
    quads = ramp(256, 256, high=2e4)
    shots = [[frame(expose(quads, e, np.random.default_rng(k)), exposure=e) for e in (1, 4)] for k in (0, 1)]
    plenty = merge(capture(*shots))
    needed = 128 * 128 * (2 * 25 + 8 + 2 * 9 + 60)
    monkeypatch.setattr(planes, "process_memory", lambda: (0, needed))
    little = merge(capture(*shots))
    for name in ("value", "variance", "quality"):
        np.testing.assert_array_equal(getattr(little, name), getattr(plenty, name))
    np.testing.assert_array_equal(little.mosaic.value, plenty.mosaic.value)
    np.testing.assert_array_equal(little.bracket.exposure_ratio, plenty.bracket.exposure_ratio)
    monkeypatch.setattr(planes, "process_memory", lambda: (1_000_000_000, needed + 999_999_999))
    with pytest.raises(SettingError, match=r"needs 1\.00 GB at least"):
        merge(capture(*shots))


def test_frames_stream(monkeypatch):
    """With room for three decoded frames, never more than these and the next are alive, of nine."""
    monkeypatch.setattr(planes, "plan_memory", lambda *_: planes.MemoryPlan(frames=3 * 2 * 256 * 256))
    quads = ramp(256, 256, high=2e4)
    alive, most = 0, 0

    def freed():
        nonlocal alive
        alive -= 1

    def lazily(exposure, seed):
        def load():
            nonlocal alive, most
            image = expose(quads, exposure, np.random.default_rng(seed))
            array = np.array(image.value)  # weak references need an owner of memory
            weakref.finalize(array, freed)
            alive += 1
            most = max(most, alive)
            return replace(image, value=array)

        return PicturedFrame("x", Exif(iso=100.0), "shot", "", load=load)

    merge(capture([lazily(e, k) for k, e in enumerate(np.geomspace(0.2, 4, 9))]))
    assert most <= 4  # one is being decoded
