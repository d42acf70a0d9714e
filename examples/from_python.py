"""The whole path from Python: a capture folder in, the object's mean normal and how sure polcap is of it out.

python examples/from_python.py CAPTURE OUT
"""

import sys
from pathlib import Path

import numpy as np

from polcap import config, pipeline
from polcap.formats import capture, maps
from polcap.path import UserInput

source, out = map(Path, sys.argv[1:3])
report = pipeline.process(
    capture.read(source),
    UserInput(),  # chart found in the picture, object found by itself, analytic estimator
    config.load(assignments=["surface.jump_px=3"]),
    out,
)
assert report is not None
found = maps.read(out / "maps").maps
print("gates:", ", ".join(f"{gate['name']} {gate['state']}" for gate in report["gates"]))
print("mean normal:", np.round(found.normal[found.mask].mean(0), 3))
print("expected error, median:", f"{np.median(found.confidence[found.mask]):.1f}°")
