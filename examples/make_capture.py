"""Photograph a half-glazed owl that does not exist: the capture bundled in examples/capture.

python examples/make_capture.py FOLDER

The bundled files hold the same counts in lossless JPEG: `python tests/benchmarks/compressed_capture.py FOLDER OUT`.
"""

import sys
import tempfile
from contextlib import chdir
from pathlib import Path

import numpy as np
import owl

from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Model
from polcap.synth.forward_camera import Sensor
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.synth.shooting import Shoot, write

GLAZE = Material((0.015, 0.11, 0.14), (0.10, 0.40, 0.36), "noise", size=0.02, roughness=(0.24, 0.30), ior=1.54, seed=4)
CLAY = Material((0.48, 0.19, 0.085), (0.66, 0.37, 0.19), "noise", size=0.008, roughness=(0.52, 0.62), ior=1.46, seed=9)

MESH = "owl.npz"  # in a temporary folder
SCENE = Scene(
    shape=Model(MESH, radius=0.088),
    coat=Coat((GLAZE, CLAY), region_size=0.22, seed=155),
    position=(-0.047, 0.0, -0.70),
    turn_deg=(8.0, 14.0, 0.0),
    light=(0.01, 0.035, 0.0),
    chart=Chart(center=(0.058, -0.012, -0.69), turn_deg=(3.0, -4.0, 1.5), pitch=0.0125),
)
SENSOR = Sensor(black=256, white=4095)  # 12 bits, so that the files stay small
SHOOT = Shoot(seed=2026, width=1536, height=1312, focal_mm=119.0, bracket="flash", sensor=SENSOR)
STEPS = {"normal": 256, "depth": 1e5, "diffuse": 512, "specular": 1024, "roughness": 512}  # per unit, of the truth

if __name__ == "__main__":
    folder = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as place, chdir(place):
        owl.write(Path(MESH))
        write(folder, SCENE, SHOOT)
    with np.load(folder / "truth.npz") as truth:
        kept = {name: (np.rint(truth[name] * n) / n).astype(truth[name].dtype) for name, n in STEPS.items()}
        np.savez_compressed(folder / "truth.npz", mask=truth["mask"], **kept)
