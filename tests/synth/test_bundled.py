"""The captures in examples/ and tests/ are those that their scripts write."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest
import rawpy

from polcap.synth import render

ROOT = Path(__file__).parents[2]
LIMITS = {"examples": 16e6, "tests": 8e6}  # bytes


@pytest.fixture(scope="module")
def scripts() -> dict[str, ModuleType]:
    found = {}
    for folder in LIMITS:
        sys.path.insert(0, str(ROOT / folder))
        spec = importlib.util.spec_from_file_location(f"make_{folder}", ROOT / folder / "make_capture.py")
        assert spec and spec.loader
        found[folder] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(found[folder])
        sys.path.pop(0)
    return found


@pytest.mark.parametrize("folder", LIMITS)
def test_bundled_capture_is_small_and_whole(folder: str) -> None:
    capture = ROOT / folder / "capture"
    truth = json.loads((capture / "truth.json").read_text())
    assert len(truth["files"]) == 9
    files = [path for path in capture.rglob("*") if path.relative_to(capture).parts[0] != "polcap"]
    assert sum(path.stat().st_size for path in files) < LIMITS[folder]
    patch = np.array(truth["chart"]["patch_corners_px"]) / 2  # binned px
    assert np.ptp(patch, axis=1).min() >= 10
    for file in truth["files"]:
        with rawpy.imread(str(capture / file["file"])) as raw:
            assert raw.raw_image_visible.shape == (truth["shoot"]["height"], truth["shoot"]["width"])


@pytest.mark.parametrize("folder", LIMITS)
def test_script_and_bundle_state_the_same_scene(scripts: dict[str, ModuleType], folder: str) -> None:
    truth, script = json.loads((ROOT / folder / "capture" / "truth.json").read_text()), scripts[folder]
    assert msgspec.convert(truth["scene"], type(script.SCENE)) == script.SCENE
    assert msgspec.convert(truth["shoot"], type(script.SHOOT)) == script.SHOOT


def test_script_and_bundle_agree(scripts: dict[str, ModuleType]) -> None:
    """Bytes agree on one machine only (the last bits of a sine differ on others), so surfaces are compared."""
    script, shoot = scripts["tests"], scripts["tests"].SHOOT
    buffer = render.gbuffer(script.SCENE, shoot.view, shoot.height, shoot.width)
    with np.load(ROOT / "tests" / "capture" / "truth.npz") as maps:
        assert (maps["mask"] != buffer.mask).sum() < 5
        both = maps["mask"] & buffer.mask
        off = np.abs(maps["normal"][both] - buffer.normal[both]).max(axis=-1)
    assert np.percentile(off, 99.9) < 1e-3  # half precision
