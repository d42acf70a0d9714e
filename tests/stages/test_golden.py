"""When a stage's pixels change, its version is raised: else caches would hand out what the old code made."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.pipeline.path import STAGES
from tests import golden

FILE = Path(golden.__file__).with_suffix(".json")
TOLERANCE = 2e-3  # of an array's length; other processors round otherwise, and an outline pixel may flip
CHOOSING = 1e-2  # where pixels choose between hypotheses: 1e-3 px of registration moves the error map by 0.3 %
REMEDY = "raise its version, then run `python -m tests.golden RESULT > tests/golden.json`"


@pytest.fixture(scope="module")
def made(result: Path) -> dict[str, Any]:
    return golden.fingerprints(result)


@pytest.mark.parametrize("stage", [*STAGES, golden.LEARNED])
def test_changed_pixels_have_a_new_version(made: dict[str, Any], stage: str) -> None:
    expected, found = json.loads(FILE.read_text())[stage], made[stage]
    assert found["version"] == expected["version"], f"{stage}: golden of another version; {REMEDY}"
    tolerance = CHOOSING if stage in ("infer", "surface", "asset", golden.LEARNED) else TOLERANCE
    changed = [
        name
        for name, now in found["arrays"].items()
        if (before := expected["arrays"].get(name)) is None
        or now["shape"] != before["shape"]
        or np.abs(np.subtract(now["projections"], before["projections"])).max()
        > tolerance * max(before["length"], 1e-9)
    ]
    assert changed == [], f"{stage} makes other pixels of the same input; {REMEDY}"


def test_fingerprint_sees_a_small_change_and_no_rounding() -> None:
    value = np.random.default_rng(0).normal(1, 0.3, (200, 200)).astype(np.float32)
    same, other = value * np.float32(1 + 1e-6), value.copy()
    other[:20, :20] *= 1.1
    seen = [np.array(golden.projections("x", array)["projections"]) for array in (value, same, other)]
    length = golden.projections("x", value)["length"]
    assert np.abs(seen[1] - seen[0]).max() < TOLERANCE * length < np.abs(seen[2] - seen[0]).max()
