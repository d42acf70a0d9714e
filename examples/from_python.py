"""The whole path from Python: a capture folder in, the object's mean normal and how sure polcap is of it out.

python examples/from_python.py CAPTURE OUT
"""

import sys

import numpy as np

import polcap

source, out = sys.argv[1:3]
result = polcap.process(source, out, config=polcap.load_config(assignments=["infer.symmetries=1"]))
found = polcap.read_maps(result.folder / "maps").maps
print(result.verdict, "gates:", ", ".join(f"{gate['name']} {gate['state']}" for gate in result.report["gates"]))
print("mean normal:", np.round(found.normal[found.mask].mean(0), 3))
print("expected error, median:", f"{np.median(found.confidence[found.mask]):.1f}°")
