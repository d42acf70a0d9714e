"""A capture through a lens that distorts gives, once the lens is calibrated, the maps of a pinhole camera."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from polcap.calibration_values import Calibration, LensGeometry
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats import calibrations
from polcap.formats.capture import reader as captures
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.results import ResultsUntilStokes
from polcap.synth import forward_camera, scenes, shooting

SHOOT = shooting.Shoot(
    seed=5, width=384, height=288, samples=1, exposures=1, focal_mm=35.0, distortion=(-0.25, 0.1), nudge_px=0.8
)


def known(size: tuple[int, int]) -> LensGeometry:
    """The simulated lens as if it had been calibrated."""
    k1, k2 = SHOOT.distortion
    return LensGeometry(
        SHOOT.view.focal, 0.5, SHOOT.view.center, 0.0, k1, 0.001, k2, 0.001, size, 0.1, 1.0, 9, "a", 35.0
    )


@pytest.fixture(scope="module")
def shot(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("lens") / "capture"
    scene = msgspec.structs.replace(scenes.random_scene(5, "bumps"), position=(-0.13, 0.07, -0.5), chart=None)
    shooting.write(place, scene, SHOOT)
    return place


def test_stokes_are_those_of_a_pinhole(shot, tmp_path, monkeypatch):
    monkeypatch.setenv("POLCAP_CALIB", str(tmp_path / "calib"))
    calibrations.write(
        tmp_path / "calib",
        Calibration("2026-11-23T00:00:00", "Polcap Synthetic", "Synthetic 35mm", "", geometry=known((384, 288))),
    )
    capture = captures.read(shot)
    assert "(calibrated)" in capture.notes[-1] and capture.focal_known
    assert any("k1 -0.2500" in note for note in capture.notes)
    truth = np.load(shot / "truth.npz")
    y, x = np.mgrid[:288.0, :384.0]
    u, v = (np.rint(at).astype(int) for at in forward_camera.undistort(SHOOT.view, SHOOT.distortion, x, y))
    inside = (u >= 0) & (v >= 0) & (u < 384) & (v < 288)
    seen = inside & truth["mask"][np.clip(v, 0, 287), np.clip(u, 0, 383)]
    supplied = UserInput(chart=ChartRequest("none"), mask=seen)
    error, overlap = {}, {}
    for name, what in (("pinhole", capture), ("as seen", replace(capture, calibration=None))):
        image = path(what, supplied, Config(), MemoryCache(), ResultsUntilStokes).stokes
        (left, top), (height, width) = np.array(image.view.origin, int), image.mask.shape
        assert image.view.center == pytest.approx((95.5 - left, 71.5 - top), abs=0.01)
        s0 = truth["S"][0].astype(float).sum(-1).reshape(144, 2, 192, 2).mean((1, 3))
        true = s0[top : top + height, left : left + width]
        solid = truth["mask"].reshape(144, 2, 192, 2).all((1, 3))[top : top + height, left : left + width]
        overlap[name] = (solid & image.mask).sum() / (solid | image.mask).sum()
        found = image.stokes[0].sum(-1)
        both = solid & image.mask
        scale = np.median(found[both] / true[both])
        error[name] = float(np.abs(found / scale - true)[both].mean() / true[both].mean())
    assert overlap["pinhole"] > 0.93 > overlap["as seen"] + 0.03
    assert error["pinhole"] < min(0.06, 0.4 * error["as seen"])  # sums of unlike channels differ a little
