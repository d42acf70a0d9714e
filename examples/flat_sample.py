"""Simulate five small views of a flat sample, and measure its material: normal, height, gloss, albedo.

python examples/flat_sample.py FOLDER
"""

import json
import subprocess
import sys
from pathlib import Path


def polcap(*words: str) -> None:
    """Run a command of polcap."""
    subprocess.run([sys.executable, "-m", "polcap", "-q", *words], check=True)


folder = Path(sys.argv[1])
small = ("width=480", "height=320", "samples=1", "exposures=1", "relief_m=0.001", "feature_m=0.016")
polcap("synth", str(folder), "--flat", "--views", "5", *(word for one in small for word in ("--set", one)))
polcap("material", str(folder), "--set", "material.gloss.materials=3")  # quicker than 6
polcap("export", str(folder / "material"), "--preset", "unreal")

figures = json.loads((folder / "material" / "report.json").read_text())["figures"]
low, high = figures["maps"]["height_mm"]
print(f"texels of {figures['maps']['texel_mm']:.2f} mm, relief of {high - low:.2f} mm")
print("roughness of the materials:", [round(one, 2) for one in figures["materials"]["roughness"]])
