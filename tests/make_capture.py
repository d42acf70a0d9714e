"""Photograph a half-glazed vase that does not exist: the small capture of the tests, tests/capture.

python tests/make_capture.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Vase
from polcap.synth.forward_camera import Sensor
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.shooting import Shoot, write

GLAZE = Material((0.03, 0.16, 0.26), (0.66, 0.62, 0.48), "veins", size=0.018, roughness=(0.20, 0.26), ior=1.54, seed=4)
CLAY = Material((0.48, 0.19, 0.085), (0.66, 0.37, 0.19), "noise", size=0.008, roughness=(0.52, 0.62), ior=1.46, seed=9)

SCENE = Scene(
    shape=Vase(
        height=0.16,
        profile=((0.0, 0.032), (0.08, 0.036), (0.46, 0.066), (0.80, 0.031), (0.90, 0.027), (1.0, 0.038)),
        lobes=9,
        depth=0.045,
        waves=(
            (0.0007, 110.0, 60.0, 20.0, 0.4),
            (0.0006, -40.0, 120.0, 70.0, 2.0),
            (0.0005, 90.0, -80.0, 60.0, 4.0),
            (0.00022, 300.0, 180.0, -120.0, 1.0),
            (0.0002, -160.0, 330.0, 90.0, 3.0),
            (0.0002, 220.0, -260.0, 240.0, 5.0),
        ),
    ),
    coat=Coat((GLAZE, CLAY), region_size=0.1, seed=24),
    position=(-0.066, 0.0, -0.70),
    turn_deg=(4.0, 25.0, -3.0),
    light=(0.01, 0.05, 0.0),
    chart=Chart(center=(0.083, -0.01, -0.69), turn_deg=(3.0, -4.0, 1.5)),
)
SENSOR = Sensor(black=256, white=4095)  # 12 bits, so that the files stay small
SHOOT = Shoot(seed=2026, width=1152, height=864, focal_mm=84.0, bracket="flash", sensor=SENSOR)
KEPT = ("normal", "depth", "mask", "diffuse", "specular", "roughness")  # of the truth; the rest follows from it

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    write(folder, SCENE, SHOOT)
    with np.load(folder / "truth.npz") as truth:
        kept = {name: truth[name] for name in KEPT}
    np.savez_compressed(folder / "truth.npz", **kept)
