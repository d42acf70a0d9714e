"""Captures that are valid and hostile: every stage ends, with a finite value or one clear error."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from polcap.config import Config
from polcap.errors import InputError
from polcap.formats import onnx
from polcap.image_values import Quality, View
from polcap.quality import gates
from polcap.quality.gate_values import State
from polcap.stage_values import AngleStack, Equipment, single_frames
from polcap.stages import align, asset, cues, infer, mask, selfcal, stokes, surface
from tests import scenes

HEIGHT, WIDTH = 36, 48
LOOKS = ("noise", "constant", "zero", "disc", "stripes", "one pixel", "ramp", "negative")
DISC = np.hypot(*np.mgrid[-18 : HEIGHT - 18, -22 : WIDTH - 22]) ** 2 < 150
FLAWS: dict[str, tuple[int, Any]] = {  # quality bit, and the pixels where it is set
    "none": (0, ...),
    "all clipped": (Quality.CLIPPED, ...),
    "half clipped": (Quality.CLIPPED, np.s_[:, :, ::2]),
    "all dark": (Quality.DARK, ...),
    "all ghosts": (Quality.GHOST, ...),
    "ball clipped": (Quality.CLIPPED, np.s_[:, DISC]),
}
MASKS = ("found", "whole", "one pixel", "line", "two specks", "disc")


def hostile(seed: int) -> tuple[AngleStack, np.ndarray | None]:
    """A stack and a user's mask (None: to be found), with random defects."""
    random = np.random.default_rng(seed)
    shots = int(random.integers(3, 7))
    angle = np.sort(random.uniform(0, np.pi, shots)) if random.integers(2) else np.arange(shots) * np.pi / shots
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    look = LOOKS[random.integers(len(LOOKS))]
    light = {
        "noise": random.uniform(0, 1, (HEIGHT, WIDTH)),
        "constant": np.full((HEIGHT, WIDTH), 0.5),
        "zero": np.zeros((HEIGHT, WIDTH)),
        "disc": 0.01 + 0.5 * DISC,
        "stripes": 0.5 + 0.5 * np.sin(x),
        "one pixel": 1.0 * ((x == 20) & (y == 20)),
        "ramp": x / WIDTH,
        "negative": -0.1 * random.uniform(0, 1, (HEIGHT, WIDTH)),
    }[look]
    wave = 1 + random.uniform(0, 1) * np.cos(2 * angle - random.uniform(0, np.pi))
    value = (light * wave[:, None, None])[..., None] * random.uniform(0.3, 1, 3)
    value = value + random.choice([0, 1e-3]) * random.normal(size=value.shape)
    quality = np.zeros(value.shape[:3], np.uint8)
    flaw, where = FLAWS[list(FLAWS)[random.integers(len(FLAWS))]]
    quality[where] = flaw
    drawn = {
        "found": None,
        "whole": np.ones((HEIGHT, WIDTH), bool),
        "one pixel": (x == 20) & (y == 20),
        "line": y == 18,
        "two specks": ((x < 4) & (y < 4)) | ((x > 40) & (y > 30)),
        "disc": DISC,
    }[MASKS[random.integers(len(MASKS))]]
    ones = np.ones((shots, 2, 3)) * np.array([1.0, random.uniform(1, 5)])[:, None]
    stack = AngleStack(
        value=value.astype(np.float32), variance=np.full(value.shape, 1e-6, np.float32), quality=quality,
        angle=angle, view=View(200.0, ((WIDTH - 1) / 2, (HEIGHT - 1) / 2), 2.0),
        bracket=replace(single_frames(shots), exposure_ratio=ones, exif_ratio=ones[..., 0]),
        equipment=Equipment(("flash", "steady", "unknown")[random.integers(3)]),
    )  # fmt: skip
    return stack, drawn


def run(radiance: AngleStack, drawn: np.ndarray | None) -> None:
    """Every stage after the merge, and the gates; a refusal by an InputError is allowed."""
    config, color = Config(), scenes.no_color()
    try:
        alignment = align.register(radiance, config.align)
        object_ = mask.segment(radiance, alignment, color, drawn, None, onnx.run, config.mask)
        calibration = selfcal.solve(radiance, alignment, object_, color, config.selfcal)
        image = stokes.solve(radiance, alignment, calibration, object_, config.stokes)
        seen = cues.compute(image, color)
        maps = infer.estimate(seen, None, onnx.run, config.infer)
        mesh = surface.integrate(maps, None, config.surface)
        built = asset.build(maps, mesh, config.asset)
    except InputError as error:
        assert "\n" not in str(error)
        return
    for array in (calibration.gains.gain, image.stokes, maps.normal, maps.diffuse, maps.confidence, mesh.vertices):
        assert np.isfinite(array).all()
    found: dict[str, Any] = {
        "names": [str(k) for k in range(len(radiance.angle))], "focal_doubt": (0.0, 0.0), "grid_px": 1.0,
        "chart_missing": "", "clipped": (radiance.quality & 1 > 0)[:, None], "blur_px": radiance.bracket.blur_px,
        "radiance": radiance, "color": color, "alignment": alignment, "object_": object_, "selfcal": calibration,
        "stokes": image, "cues": seen, "maps": maps, "mesh": mesh,
    }  # fmt: skip
    judged = gates.judge(scenes.evidence(**found), config.gates)
    assert all(gate.message and gate.state in get_args(State) for gate in judged)
    assert built.base_color.dtype == np.uint8


@pytest.mark.timeout(300)
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("first", range(0, 40, 20))
def test_hostile_captures_end(first: int) -> None:
    for seed in range(first, first + 20):
        try:
            run(*hostile(seed))
        except (InputError, AssertionError, RuntimeWarning, ValueError, IndexError, ZeroDivisionError) as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__} {error}") from error


def test_filling_ends_where_nothing_known_reaches() -> None:
    stack, _ = hostile(0)
    clipped = np.full(stack.quality.shape, np.uint8(Quality.CLIPPED))
    clipped[:, 0, 0] = 0
    run(replace(stack, quality=clipped), np.ones((HEIGHT, WIDTH), bool))
