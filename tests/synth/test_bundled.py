"""The capture in examples/ is the one that its script writes."""

import importlib.util
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rawpy

from polcap.synth import render

EXAMPLES = Path(__file__).parents[2] / "examples"
CAPTURE = EXAMPLES / "capture"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("make_capture", EXAMPLES / "make_capture.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_bundled_capture_is_small_and_whole() -> None:
    truth = json.loads((CAPTURE / "truth.json").read_text())
    assert len(truth["files"]) == 9
    assert sum(p.stat().st_size for p in CAPTURE.rglob("*") if p.relative_to(CAPTURE).parts[0] != "polcap") < 8e6
    patch = np.array(truth["chart"]["patch_corners_px"]) / 2  # binned px
    assert np.ptp(patch, axis=1).min() >= 10
    for file in truth["files"]:
        with rawpy.imread(str(CAPTURE / file["file"])) as raw:
            assert raw.raw_image_visible.shape == (truth["shoot"]["height"], truth["shoot"]["width"])


def test_script_and_bundle_agree(script) -> None:
    """Bytes agree on one machine only (the last bits of a sine differ on others), so surfaces are compared."""
    truth = json.loads((CAPTURE / "truth.json").read_text())
    assert msgspec.convert(truth["scene"], type(script.SCENE)) == script.SCENE
    assert msgspec.convert(truth["shoot"], type(script.SHOOT)) == script.SHOOT
    shoot = script.SHOOT
    buffer = render.gbuffer(script.SCENE, shoot.view, shoot.height, shoot.width)
    with np.load(CAPTURE / "truth.npz") as maps:
        assert (maps["mask"] != buffer.mask).sum() < 5
        both = maps["mask"] & buffer.mask
        off = np.abs(maps["normal"][both] - buffer.normal[both]).max(axis=-1)
    assert np.percentile(off, 99.9) < 1e-3  # half precision
