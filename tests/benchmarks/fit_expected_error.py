"""Pictures of training meshes in, `_CALIBRATION` of `infer/learned.py` out: how the expected normal error is scaled.

    python tests/benchmarks/fit_expected_error.py FOLDER [--model ONNX] [--pictures 10]

FOLDER is laid out as the evaluation's data, with training meshes in meshes/test and training materials in
materials/test (links do). Makes PICTURES of each protocol at 256² and prints a, b and r of
error = a·statedᵇ·exp(r·roughness), those under which the errors are likeliest as draws of exponential distributions of
these means, as the network's own were learned; and what is predicted by what is found, in tenths.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from polcap import models
from polcap.images import Floats, Network
from polcap.stages import infer
from polcap.stages.infer import learned
from polcap.training.protocol import PROTOCOLS, Protocol
from polcap.training.score import angle, deciles

SIZE, SAMPLE = 256, 1500  # px; pixels of each picture
GREATEST_DEG = 60.0  # errors that count: a wrong half-turn weighs no more
_AS_STATED = (1.0, 1.0, 0.0, np.inf)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--pictures", type=int, default=10)
    options = parser.parse_args()
    network = models.load_network("network", options.model, "cpu", 1)
    assert network is not None
    learned._CALIBRATION = _AS_STATED  # what the join itself states
    found = {w: drawn(Protocol(options.folder, SIZE, w), network, options.pictures) for w in PROTOCOLS}
    a, b, r = fit(np.concatenate(list(found.values()), axis=1))
    print(f"error = {a:.3g} · stated^{b:.3g} · exp({r:.3g} · roughness)")
    for which, (stated, roughness, error) in found.items():
        tenths = deciles(a * stated**b * np.exp(r * roughness), error)
        print(f"protocol {which}:", " ".join(f"{d['predicted'] / d['actual']:.2f}" for d in tenths))


def drawn(pictures: Protocol, network: Network, count: int) -> Floats:
    """Stated error, roughness and true error (3, N) of pixels of the first pictures."""
    parts = []
    for number in range(count):
        case = pictures.case(number)
        maps = infer.estimate(case.cues, network, infer.Settings())
        inside = case.truth.mask & maps.mask
        some = np.random.default_rng(number).permutation(int(inside.sum()))[:SAMPLE]
        parts.append([x[inside][some] for x in (maps.confidence, maps.roughness, angle(maps, case))])
    return np.concatenate(parts, axis=1)


def fit(pixels: Floats) -> tuple[float, float, float]:
    """a, b and r of least mean of log σ + error/σ."""
    stated, roughness, error = pixels.astype(np.float64)
    terms = np.stack([np.ones_like(stated), np.log(np.maximum(stated, 0.1)), roughness])
    capped = np.minimum(error, GREATEST_DEG)

    def unlikely(weights: Floats) -> float:
        log = weights @ terms
        return float(np.mean(log + capped * np.exp(-log)))

    best = minimize(unlikely, np.array([0.0, 1.0, 0.0]))
    return float(np.exp(best.x[0])), float(best.x[1]), float(best.x[2])


if __name__ == "__main__":
    main()
