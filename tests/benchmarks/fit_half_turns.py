"""Fits `_WRONG`, `_REGION` and `_CELL` of `infer/shape/half_turns.py` (odds of a wrong azimuth side) on known normals.

    python tests/benchmarks/fit_half_turns.py DATA --scenes FOLDER … [--sixths 27] [--model ONNX]

The scenes are folders of `make_mitsuba.py`, of training meshes: black gloss and others; every third is seen under the
rough law. Added to them are six pictures for each of --sixths: training meshes and materials in both protocols at 256².

Cells of the network and of the inversion whose two sides differ by more than 10° give `_WRONG` and `_CELL`; every
picture counts alike. Then the cut is made with half, the usual and twice the weight of the network, for more regions
to learn from. A region counts by what turning it changes of the mean normal error, 0.5° at most, over the root of the
regions of its picture. Prints the three laws, and what the accepted regions gain and lose.
"""

import tempfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from bench_mitsuba import read
from numpy.typing import NDArray
from scipy.optimize import minimize

from polcap.formats import onnx
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.optics.resize import area_mean
from polcap.stage_values import Cues, Network
from polcap.stages.infer import analytic, learned, sizes_and_positions
from polcap.stages.infer.shape import half_turns
from polcap.training import evaluation_materials, evaluation_protocol, traced_views
from polcap.training.evaluation_protocol import Case, Protocol
from tests.experiments import arguments, networks

MOST_DEG = 0.5  # that one region counts for
CLEAR_DEG = 10.0  # cells whose two sides differ by less say nothing
SHRINK = 1e-4  # weight of the squared coefficients
SIZE = 256  # px, of the protocols' pictures
MESHES = 6  # of the evaluation
OTHER_SEEDS = 2028, 20281128  # of patterns and pictures: not the evaluation's


def main() -> None:
    options = arguments(__doc__, "data", scenes=[], sixths=27, model=Path)
    network = networks("network", options.model)[0]
    assert network is not None
    network_cells, cells, grids = [], [], []
    for case in chain(path_traced([Path(one) for one in options.scenes]), pictures(options.data, options.sixths)):
        grid, terms, change = predicted(case, network)
        clear = np.abs(change) > CLEAR_DEG
        network_cells.append((terms[clear], change[clear] > 0, np.full(int(clear.sum()), 1 / max(int(clear.sum()), 1))))
        grids.append((grid, terms, change / max(int(grid.mask.sum()), 1)))
        cells.append(inverted(case))
        print(case.name, flush=True)
    wrong = fit(*(np.concatenate(column) for column in zip(*network_cells)))
    print("_WRONG =", rounded(wrong))
    odds, gain, weight = (np.concatenate(column) for column in zip(*(proposed(*one, wrong) for one in grids)))
    terms = np.stack([np.ones(len(odds)), odds], axis=-1)
    law = fit(terms, gain > 0, np.minimum(np.abs(gain), MOST_DEG) * weight)
    accepted = terms @ law > 0
    gained, lost = (gain[accepted & side].sum() for side in (gain > 0, gain < 0))
    print("_REGION =", rounded(law), f"gains {gained:.1f}°, loses {-lost:.1f}° in all")
    print("_CELL =", rounded(fit(*(np.concatenate(column) for column in zip(*cells)))))


def rounded(law: Floats) -> tuple[float, ...]:
    return tuple(float(f"{one:.3g}") for one in law)


def path_traced(folders: list[Path]) -> Iterator[Case]:
    """Scenes of `make_mitsuba.py` as a camera measures them."""
    for number, file in enumerate(file for folder in folders for file in sorted(folder.glob("*.npz"))):
        yield read(file, clean=False, rough=number % 3 == 1, seed=number)[0]


def pictures(data: Path, sixths: int) -> Iterator[Case]:
    """Training meshes and materials as `polcap evaluate` draws its own, in either protocol by turns."""
    evaluation_materials._SEED, evaluation_protocol._SEED = OTHER_SEEDS
    meshes = len(traced_views.training_meshes(data))
    for sixth in range(sixths):
        with tempfile.TemporaryDirectory() as folder:
            linked(data, Path(folder), sixth, meshes)
            drawn = [Protocol(Path(folder), SIZE, which) for which in (2, 1)]
            for number in range(MESHES):
                yield drawn[number % 2].case(sixth * MESHES + number)


def linked(data: Path, folder: Path, sixth: int, meshes: int) -> None:
    """Link six training meshes and ten training materials where `Protocol` looks for the evaluation's."""
    turn, place = divmod(sixth, meshes // MESHES)
    own = np.random.default_rng(turn).permutation(meshes)[place * MESHES :][:MESHES]
    files = traced_views.training_meshes(data)
    sets = sorted(path.parent for path in (data / "materials" / "train").glob("*/albedo.jpg"))
    worn = np.random.default_rng([sixth]).permutation(len(sets))[: evaluation_materials.TEXTURES]
    for kind, chosen in (("meshes", [files[k] for k in own]), ("materials", [sets[k] for k in worn])):
        (folder / kind / "test").mkdir(parents=True)
        for path in chosen:
            (folder / kind / "test" / path.name).symlink_to(path.resolve())


def predicted(case: Case, network: Network) -> tuple[half_turns.Grid, Floats, Floats]:
    """The network's normals on the coarse grid, terms (h, w, 4) of `_WRONG`, and what turning a cell gains, degrees."""
    shrink = max(1.0, max(case.cues.mask.shape) / int(network.metadata["native_size"]))
    seen = learned._reduce(learned._limit_radiance(case.cues), 1 / shrink)
    maps = sizes_and_positions.predict([seen], network, onnx.run, 4)
    grid = half_turns.coarse(frames.to_ray_frame(frames.unit(maps["normal"]), seen.rays), seen.mask)
    overview = learned._overview(seen, 1.0, network, onnx.run)
    doubt = half_turns.NetworkDoubt(maps["sigma"], maps["opposed"], overview)
    return grid, half_turns.wrong_terms(grid, doubt, seen.mask), gain_of_turning(grid, case)


def proposed(grid: half_turns.Grid, terms: Floats, change: Floats, wrong: Floats) -> tuple[Floats, Floats, Floats]:
    """Regions that the cut turns: mean log odds, gain in mean error [degrees], and weight of each, (R,)."""
    usual = half_turns._NETWORK
    odds, gains = [], []
    for factor in (0.5, 1.0, 2.0):
        half_turns._NETWORK = factor * usual
        region, of_region = half_turns.proposals(grid, terms @ wrong)
        odds.append(of_region[1:])
        gains.append(np.bincount(region.ravel(), change.ravel(), len(of_region))[1:])
    half_turns._NETWORK = usual
    gain = np.asarray(np.concatenate(gains), np.float64)
    return np.concatenate(odds), gain, np.full(len(gain), 1 / np.sqrt(max(len(gain), 1)))


def inverted(case: Case) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Cells of the inversion: terms (N, 4), whether each is on the wrong side (N,), weights (N,)."""
    cues: Cues = case.cues
    normal, _, _ = analytic.invert(cues, 1.5)
    grid = half_turns.coarse(frames.to_ray_frame(normal, cues.rays), cues.mask)
    turned, terms = half_turns.sides(grid)
    gain = gain_of_turning(grid, case)
    clear = np.abs(gain) > CLEAR_DEG
    weight = np.full(int(clear.sum()), 1 / max(int(grid.mask.sum()), 1))
    return terms[clear], (np.where(turned, -gain, gain) > 0)[clear], weight


def gain_of_turning(grid: half_turns.Grid, case: Case) -> Floats:
    """Error of each cell's normal less that of its half-turn, degrees (h, w); 0 outside."""
    local = frames.to_ray_frame(case.truth.normal, case.cues.rays) * case.truth.mask[..., None]
    truth = frames.unit(area_mean(local.astype(np.float32), grid.mask.shape))
    lean = np.moveaxis(grid.lean, 0, -1)
    cosine = np.sqrt(np.maximum(1 - (lean**2).sum(axis=-1), 0)) * truth[..., 2]
    across = (lean * truth[..., :2]).sum(axis=-1)
    kept, turned = (np.degrees(np.arccos(np.clip(cosine + sign * across, -1, 1))) for sign in (1, -1))
    return np.asarray((kept - turned) * grid.mask)


def fit(terms: Floats, true: NDArray[np.bool_], weight: Floats) -> Floats:
    """Logistic coefficients of maximum likelihood, rows weighted by `weight`; all but the first are shrunk a little."""
    sign = np.where(true, 1.0, -1.0)

    def unlikely(law: Floats) -> float:
        return float(weight @ np.logaddexp(0, -sign * (terms @ law)) / weight.sum() + SHRINK * (law[1:] ** 2).sum())

    return np.asarray(minimize(unlikely, np.zeros(terms.shape[1])).x)


if __name__ == "__main__":
    main()
