"""Train the fine pass: `python -m polcap.training.fine_train DATA MODEL OUT MINUTES`; goes on where it was stopped.

MODEL is the first network's file. Pictures are made first (`fine_pictures.py`), then learned from in tiles. Leaves
OUT/fine.onnx, last.pt and metrics.csv.
"""

import csv
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polcap.formats import onnx
from polcap.images import Floats
from polcap.stages.infer import fine
from polcap.training import export, fine_model, fine_pictures
from polcap.training.small_run import SmallRun

_PICTURES, _TILES, _TILE = 4, 4, 96  # pictures a step, tiles of each, their side, px
_HELD = 24  # pictures that are only looked at
_DOUBLED = tuple(fine.CHANNELS.index(name) for name in ("s1", "zenith_x", "cos_2phi"))  # and the channel after each
_VECTORS = tuple(fine.CHANNELS.index(name) for name in ("ray_x", "normal_x", "smooth_x"))
_NORMAL, _COUNT = fine.CHANNELS.index("normal_x"), len(fine.CHANNELS)


@dataclass(frozen=True)
class Params:
    """What one training run is told."""

    data: Path  # holds meshes/ and materials/
    model: Path  # the first network
    out: Path
    minutes: float = 40.0  # of training, resumed parts together
    pictures: int = 400
    rate: float = 2e-3  # of Muon; half of it for AdamW
    seed: int = 1


def main(params: Params) -> Path:
    """Make the pictures that are missing, train, export."""
    torch.set_num_threads(1)
    folder = params.out / "pictures"
    if len(list(folder.glob("[0-9]*.npy"))) < params.pictures:
        network = onnx.load(params.model, threads=1)
        studio = fine_pictures.Studio.open(params.out / "views", params.data, network)
        fine_pictures.main(folder, studio, params.pictures)
    files = sorted(folder.glob("[0-9]*.npy"))
    torch.manual_seed(params.seed)
    run = Run(params.rate)
    run.spend(params.minutes, files, _HELD, _PICTURES, params.seed, params.out)
    return ship(params.out / "last.pt", params.out / "fine.onnx")


class Run(SmallRun):
    """The network in training, by its own pictures."""

    made, warm, keep = fine_model.Network, 30, 0.995

    def advance(self, files: list[Path], progress: float, rng: np.random.Generator) -> float:
        """One step; its loss."""
        self.pace(progress)
        drawn = [tile(taught(file), rng) for file in files for _ in range(_TILES)]
        loss = fine_model.loss(*answered(self.network, np.stack(drawn)))
        loss.backward()
        self.learn()
        return float(loss.detach())

    def look(self, path: Path, losses: Any, files: list[Path]) -> None:
        """A row of metrics."""
        _record(path, self, float(losses), *self.judge(files))

    def judge(self, files: list[Path]) -> tuple[float, float]:
        """Distance of the relief from the truth, rms, with the averaged weights and without any relief."""
        network = averaged(self.average)
        left, whole = [], []
        for file in files:
            picture = taught(file)
            height, width = (side - side % fine.SIZE_MULTIPLE for side in picture.shape[1:])
            with torch.no_grad():
                relief, target, known = answered(network, picture[None, :, :height, :width])
            left.append(float((((relief - target) * known) ** 2).sum() / known.sum()))
            whole.append(float(((target * known) ** 2).sum() / known.sum()))
        return float(np.sqrt(np.mean(left))), float(np.sqrt(np.mean(whole)))


def averaged(weights: dict[str, Tensor]) -> fine_model.Network:
    network = fine_model.Network()
    network.load_state_dict(weights)
    network.eval()
    return network


@cache
def taught(file: Path) -> NDArray[np.float16]:
    """A picture's channels, the relief that should be found (3) and where it is known (1)."""
    picture = np.load(file)
    shown = picture[:_COUNT].astype(np.float32)
    truth, known = picture[_COUNT : _COUNT + 3].astype(np.float32), picture[-1] > 0
    shrink = float(np.exp(shown[-1].max()))
    relief = fine.finer(np.moveaxis(truth - shown[_NORMAL : _NORMAL + 3], 0, -1), known, shrink)
    return np.concatenate([picture[:_COUNT], np.moveaxis(relief, -1, 0), known[None]]).astype(np.float16)


def tile(picture: NDArray[np.float16], rng: np.random.Generator) -> Floats:
    """A square of a picture about a place of the object, turned and mirrored at random."""
    inside = np.flatnonzero(picture[-1])
    y, x = divmod(int(inside[rng.integers(len(inside))]), picture.shape[2])
    pad = _TILE // 2
    top, left = max(0, pad - y), max(0, pad - x)
    shown = picture[:, max(0, y - pad) : y + pad, max(0, x - pad) : x + pad]
    out = np.zeros((len(picture), _TILE, _TILE), np.float32)
    out[:, top : top + shown.shape[1], left : left + shown.shape[2]] = shown
    return turned(out, int(rng.integers(4)), bool(rng.integers(2)))


def turned(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """A scene mirrored left to right, then turned counter-clockwise: pixels, and what points in the picture."""
    out = np.array(np.rot90(picture[..., ::-1] if mirror else picture, quarters, axes=(1, 2)))
    for first in _DOUBLED:  # twice the angle: a quarter negates, a mirror conjugates
        out[first : first + 2] *= (-1.0) ** quarters
        out[first + 1] *= -1.0 if mirror else 1.0
    for first in (*_VECTORS, _COUNT):
        x, y = (-out[first] if mirror else out[first].copy()), out[first + 1].copy()
        for _ in range(quarters):
            x, y = -y, x
        out[first], out[first + 1] = x, y
    return out


def answered(network: fine_model.Network, pictures: Floats) -> tuple[Tensor, Tensor, Tensor]:
    """Relief, what it should be, and where that is known, of pictures (B, N + 4, H, W)."""
    batch = torch.from_numpy(pictures.astype(np.float32))
    shown = batch[:, :_COUNT].contiguous(memory_format=torch.channels_last)
    return network(shown), batch[:, _COUNT : _COUNT + 3], batch[:, _COUNT + 3 :]


def ship(checkpoint: Path, path: Path) -> Path:
    """The averaged weights of a checkpoint as the model that `formats/onnx.py` loads."""
    state = torch.load(checkpoint, weights_only=True)
    metadata = {
        "channels": ",".join(fine.CHANNELS), "encoding": fine.ENCODING, "native_size": str(fine_pictures.SIDE),
        "size_multiple": str(fine.SIZE_MULTIPLE), "licence": "Apache-2.0",
        "outputs": "relief: added to the normal so far, in the frame of each ray",
        "training": f"{state['step'] * _PICTURES * _TILES} tiles of {_TILE} px in {state['step']} steps",
    }  # fmt: skip
    export.save(averaged(state["average"]), path, ("relief",), metadata)
    return path


def _record(path: Path, run: Run, loss: float, left: float, whole: float) -> None:
    row = {"step": run.step, "seconds": round(run.elapsed), "loss": loss, "off": left, "off_without": whole}
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if fresh:
            writer.writeheader()
        writer.writerow({k: f"{v:.4g}" for k, v in row.items()})
    print(" ".join(f"{k} {v:.4g}" for k, v in row.items()), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(Params(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4])))
