"""The whole path from Python: a capture folder in, the object's mean normal and how sure polcap is of it out.

python examples/from_python.py CAPTURE OUT
"""

import sys

import numpy as np

import polcap

if len(sys.argv) != 3:
    sys.exit(__doc__)
source, out = sys.argv[1:3]
result = polcap.process(source, out, config=polcap.load_config(assignments=["infer.symmetries=1"]))
found = polcap.read_maps(result.folder)
print(result.verdict, "gates:", ", ".join(f"{gate['name']} {gate['state']}" for gate in result.report["gates"]))
print("mean normal:", np.round(found.normal[found.mask].mean(0), 3))
print("depth, median:", f"{np.nanmedian(found.depth):.3f}", "m" if found.metric else "(relative)")
print("DoLP, median:", f"{np.median(polcap.read_cues(result.folder)['dolp'][found.mask]):.3f}")
print("expected error, median:", f"{np.median(found.confidence[found.mask]):.1f}°")
