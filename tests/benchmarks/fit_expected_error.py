"""Training meshes and materials in, `_CALIBRATION` of `infer/learned.py` out: how the expected normal error is scaled.

    python tests/benchmarks/fit_expected_error.py DATA OUT [--model ONNX] [--rounds 3]

Each round shows every training mesh once in each protocol and size, under training materials and patterns that are
not the evaluation's; what is found there is kept in OUT, so that another fit costs nothing. Prints a and b of
error = a·statedᵇ, the most probable ones if errors are drawn from exponential distributions with these means, as in the
network's own loss; and the ratio of stated to actual error, in tenths. RAW captures have smaller errors.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from polcap.formats import atomic, onnx
from polcap.image_values import Floats
from polcap.pipeline import models
from polcap.stage_values import Network
from polcap.stages import infer
from polcap.stages.infer import learned
from polcap.training import evaluation_materials, evaluation_protocol, traced_views
from polcap.training.evaluation_protocol import PROTOCOLS, Case, Protocol
from polcap.training.map_errors import angle, deciles

SIZES, SAMPLE = (256, 512), 3000  # px; pixels of each picture
MESHES = 6  # of the evaluation
GREATEST_DEG = 60.0  # errors that count: a wrong half-turn weighs no more
OTHER_SEEDS = 2028, 20281128  # of patterns and pictures: not the evaluation's
_AS_STATED = (1.0, 1.0, np.inf)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    network = models.load_network("network", options.model, "cpu", 1)
    assert network is not None
    learned._CALIBRATION = _AS_STATED  # what the join itself states
    evaluation_materials._SEED, evaluation_protocol._SEED = OTHER_SEEDS
    options.out.mkdir(parents=True, exist_ok=True)
    shown = [(size, which) for size in SIZES for which in PROTOCOLS]
    found = {key: drawn(options.data, options.out, network, *key, options.rounds) for key in shown}
    a, b = fit(list(found.values()))
    print(f"error = {a:.3g} · stated^{b:.3g}")
    for (size, which), (stated, error) in found.items():
        tenths = deciles(a * stated**b, error)
        ratios = " ".join(f"{d['predicted'] / d['actual']:.2f}" for d in tenths)
        print(f"{size}², protocol {which}: {ratios}")


def drawn(data: Path, out: Path, network: Network, size: int, which: int, rounds: int) -> Floats:
    """Stated and true error (2, N) of pixels of one size and protocol."""
    parts = []
    meshes = len(traced_views.training_meshes(data))
    for first in range(0, rounds * meshes, MESHES):
        files = {number: out / f"{size}_{which}_{number:03d}.npy" for number in range(first, first + MESHES)}
        missing = {number: file for number, file in files.items() if not file.exists()}
        if missing:
            with tempfile.TemporaryDirectory() as folder:
                linked(data, Path(folder), first // MESHES, meshes)
                pictures = Protocol(Path(folder), size, which)
            for number, file in missing.items():
                with atomic.path(file) as beside, beside.open("wb") as stream:
                    np.save(stream, pixels(pictures.case(number), network, number))
        parts += [np.load(file) for file in files.values()]
    return np.concatenate(parts, axis=1)


def linked(data: Path, folder: Path, sixth: int, meshes: int) -> None:
    """Six training meshes and ten training materials where `Protocol` looks for the evaluation's."""
    turn, place = divmod(sixth, meshes // MESHES)
    own = np.random.default_rng(turn).permutation(meshes)[place * MESHES :][:MESHES]
    files = traced_views.training_meshes(data)
    sets = sorted(path.parent for path in (data / "materials" / "train").glob("*/albedo.jpg"))
    worn = np.random.default_rng([sixth]).permutation(len(sets))[: evaluation_materials.TEXTURES]
    for kind, chosen in (("meshes", [files[k] for k in own]), ("materials", [sets[k] for k in worn])):
        (folder / kind / "test").mkdir(parents=True)
        for path in chosen:
            (folder / kind / "test" / path.name).symlink_to(path.resolve())


def pixels(case: Case, network: Network, seed: int) -> Floats:
    """Stated and true error (2, N) of some pixels of a picture."""
    maps = infer.estimate(case.cues, network, onnx.run, infer.InferSettings())
    mask = case.truth.mask
    some = np.random.default_rng(seed).permutation(int(mask.sum()))[:SAMPLE]
    return np.stack([image[mask][some] for image in (maps.confidence, angle(maps, case))])


def fit(groups: list[Floats]) -> tuple[float, float]:
    """a and b of least mean of log σ + error/σ, each group counting alike."""
    stated, error = np.concatenate(groups, axis=1).astype(np.float64)
    share = np.concatenate([np.full(group.shape[1], 1 / group.shape[1] / len(groups)) for group in groups])
    terms = np.stack([np.ones_like(stated), np.log(np.maximum(stated, 0.1))])
    capped = np.minimum(error, GREATEST_DEG)

    def unlikely(weights: Floats) -> float:
        log = weights @ terms
        return float(share @ (log + capped * np.exp(-log)))

    best = minimize(unlikely, np.array([0.0, 1.0]))
    return float(np.exp(best.x[0])), float(best.x[1])


if __name__ == "__main__":
    main()
