"""Fingerprints of what each stage makes of the bundled capture, tolerant of rounding, not of a change.

    python -m tests.golden RESULT > tests/golden.json

RESULT is made by `polcap process examples/capture --estimator analytic`. An array is described by four
projections on fixed random signs, relative to its length: a change δ moves each by about |δ|/|x|.
"""

import json
import sys
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from polcap import stages
from polcap.formats import npy_folder
from polcap.pipeline import models, path
from polcap.pipeline import run as pipeline
from polcap.stages import infer

LEARNED = "infer by the shipped network"


def versions() -> dict[str, int]:
    rooms = (vars(path)[name] for name in path.STAGES)
    found = [value for room in rooms for value in vars(room).values() if isinstance(value, stages.Stage)]
    return {stage.name: stage.version for stage in found}


def fingerprints(result: Path) -> dict[str, dict[str, Any]]:
    """Stage → version and array → shape and projections; last the shipped network's maps of the same cues."""
    opened, _ = pipeline.reopen(result)
    version: dict[str, Any] = versions()
    made = {stage.name: _entry(version[stage.name], stage.name, stage.value) for stage in vars(opened).values()}
    network = models.load_network("network", None, "cpu", 1)
    assert network is not None
    maps = infer.estimate(opened.cues.value, network, infer.Settings())
    made[LEARNED] = _entry([version["infer"], network.digest], "infer", maps)
    return made


def _entry(version: Any, name: str, value: Any) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    npy_folder.encode(value, name, arrays)
    return {"version": version, "arrays": {name: projections(name, a) for name, a in arrays.items()}}


def projections(name: str, array: Any) -> dict[str, Any]:
    value = np.nan_to_num(np.asarray(array, np.float64)).ravel()
    length = float(np.linalg.norm(value))
    signs = np.random.default_rng(crc32(name.encode())).choice([-1.0, 1.0], (4, value.size))
    return {"shape": list(array.shape), "length": length, "projections": [float(x) for x in signs @ value]}


if __name__ == "__main__":
    json.dump(fingerprints(Path(sys.argv[1])), sys.stdout, indent=1)
    print()
