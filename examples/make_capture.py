"""Photograph a glazed vase that does not exist: the capture bundled in examples/capture, byte for byte.

python examples/make_capture.py FOLDER
"""

import sys
from pathlib import Path

from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Vase
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.shooting import Scene, Shoot, write

GLAZE = Material((0.05, 0.22, 0.30), (0.62, 0.60, 0.48), "veins", size=0.022, roughness=(0.30, 0.36), ior=1.52, seed=4)
CLAY = Material((0.52, 0.22, 0.10), (0.66, 0.38, 0.20), "noise", size=0.012, roughness=(0.50, 0.58), ior=1.46, seed=9)

SCENE = Scene(
    shape=Vase(
        height=0.16,
        profile=((0.0, 0.032), (0.08, 0.036), (0.46, 0.066), (0.80, 0.031), (0.90, 0.027), (1.0, 0.038)),
        lobes=9,
        depth=0.045,
        waves=((0.0007, 110.0, 60.0, 20.0, 0.4), (0.0006, -40.0, 120.0, 70.0, 2.0), (0.0005, 90.0, -80.0, 60.0, 4.0)),
    ),
    coat=Coat((GLAZE, CLAY), region_size=0.1, seed=24),
    position=(-0.08, 0.0, -0.70),
    turn_deg=(4.0, 25.0, -3.0),
    light=(0.01, 0.05, 0.0),
    chart=Chart(center=(0.115, -0.01, -0.69), turn_deg=(3.0, -4.0, 1.5)),
)
SHOOT = Shoot(seed=2026, width=768, height=576)

if __name__ == "__main__":
    write(Path(sys.argv[1]), SCENE, SHOOT)
