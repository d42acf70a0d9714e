"""A result for Unreal and for a web page: each folder's files, and what their textures hold, from maps.json.

python examples/export_presets.py RESULT
"""

import json
import sys
from pathlib import Path

from polcap.pipeline import run as pipeline
from polcap.pipeline.export_request import ExportRequest

result = Path(sys.argv[1])
layers = ExportRequest(formats=("exr",), color="ACEScg")
for wanted in (ExportRequest(preset="unreal"), ExportRequest(preset="web"), layers):
    for file in pipeline.export(result, wanted):
        print(f"{file.relative_to(result)}  {file.stat().st_size / 1e6:.2f} MB")
exports = json.loads((result / "maps" / "maps.json").read_text(encoding="utf-8"))["exports"]
for folder, told in exports.items():
    print(f"\n{folder}: {told['for']}; unit of length: {told['unit']}")
    for name, holds in {**told["glb"], **told["textures"]}.items():
        print(f"  {name}: {holds}")
