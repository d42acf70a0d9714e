"""A network of one's own: ten seconds of learning from one random shape, written as ONNX, used on a capture.

python examples/own_network.py CAPTURE OUT

Needs the extra [train]. A real one is `polcap train DATA`: the same calls, a larger network, hours.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

from polcap.training import main_network, random_shapes, train

if len(sys.argv) != 3:
    sys.exit(__doc__)
source, out = map(Path, sys.argv[1:3])
for seed, split in enumerate(("train", "test")):  # training looks at pictures of the latter as it goes
    mesh, folder = random_shapes.compose(np.random.default_rng(seed)), out / "data" / "meshes" / split
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0).max()
    corners = np.rint((mesh.vertices - low) / size * 65535).astype(np.uint16)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "shape.npz", vq=corners, vmin=low, vscale=np.float32(size), faces=mesh.faces)

tiny = main_network.NetworkShape((8, 16, 16, 16, 16), (8, 8, 16, 16), (8, 8, 8, 8), (8, 8, 8, 8), (1, 1, 1, 1, 1))
train.PRESETS["cpu"] = train.TrainingPreset(tiny, 4, 1, 1, 64, (32, 64), (0.5, 0.5), (0.2, 0.8), 4 * 64**2)
own = train.main(train.TrainingOptions(data=out / "data", out=out / "mine", minutes=10 / 60, threads=1))

polcap = [sys.executable, "-m", "polcap", "process", str(source), "--model", str(own), "--out", str(out / "result")]
sys.exit(subprocess.run(polcap).returncode)
