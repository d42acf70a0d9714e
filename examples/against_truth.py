"""Errors of a result against the truth of a synthetic capture, over the pixels that are on the object in both.

python examples/against_truth.py CAPTURE RESULT    (CAPTURE of `polcap synth`, RESULT of `polcap process`)
"""

import sys
from pathlib import Path

import numpy as np

import polcap

if len(sys.argv) != 3:
    sys.exit(__doc__)
capture, result = map(Path, sys.argv[1:])
found = polcap.read_maps(result)
step, (height, width) = int(found.view.scale), found.mask.shape
left, top = (round(place * found.view.scale) for place in found.view.origin)  # RAW px


def truth(name: str) -> np.ndarray:
    """A true map on the grid of the result's maps: the mean of the RAW pixels under each of them."""
    with np.load(capture / "truth.npz") as file:
        cut = file[name][top : top + step * height, left : left + step * width].astype(np.float32)
    return np.asarray(cut.reshape(height, step, width, step, *cut.shape[2:]).mean(axis=(1, 3)))


both = found.mask & (truth("mask") == 1)
print(f"mask: {both.sum() / (found.mask | (truth('mask') == 1)).sum():.0%} overlap with the true one")
normal = truth("normal")[both]
normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
angle = np.degrees(np.arccos(np.clip(np.sum(normal * found.normal[both], axis=-1), -1, 1)))
expected = found.confidence[both]
print(f"normals: mean {angle.mean():.2f}°, median {np.median(angle):.2f}°, expected mean {expected.mean():.2f}°")
below, twice = np.mean(angle < expected), np.mean(angle < 2 * expected)
print(f"below the expected error: {below:.0%} of the pixels; below twice of it: {twice:.0%}")
for name, estimate in {"diffuse": found.diffuse, "specular": found.specular, "roughness": found.roughness}.items():
    print(f"{name}: RMSE {np.sqrt(np.mean((truth(name)[both] - estimate[both]) ** 2)):.4f}")
