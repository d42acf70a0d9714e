"""Train the fine pass: `python -m polcap.training.fine_train DATA MODEL OUT MINUTES`; goes on where it was stopped.

MODEL is the first network's file. Pictures are made first (`fine_pictures.py`), then learned from in tiles. Leaves
OUT/fine.onnx, last.pt and metrics.csv.
"""

import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from polcap.formats import onnx
from polcap.images import Floats
from polcap.stages.infer import fine
from polcap.training import export, fine_model, fine_pictures, loop

_TILES, _TILE = 4, 96  # tiles of a picture in a step; their side, px
_DOUBLED = tuple(fine.CHANNELS.index(name) for name in ("s1", "zenith_x", "cos_2phi"))  # and the channel after each
_VECTORS = tuple(fine.CHANNELS.index(name) for name in ("ray_x", "normal_x", "smooth_x"))
_NORMAL, _COUNT = fine.CHANNELS.index("normal_x"), len(fine.CHANNELS)


@dataclass(frozen=True)
class FineTrainingOptions:
    """One training run of the fine pass."""

    data: Path  # holds meshes/ and materials/
    model: Path  # the first network
    out: Path
    minutes: float = 40.0  # of training, resumed parts included
    pictures: int = 400
    rate: float = 2e-3  # of Muon
    seed: int = 1


def main(options: FineTrainingOptions) -> Path:
    """Make the pictures that are missing, train, export."""
    torch.set_num_threads(1)
    folder = options.out / "pictures"
    if len(list(folder.glob("[0-9]*.npy"))) < options.pictures:
        network = onnx.load(options.model, threads=1)
        studio = fine_pictures.Studio.open(options.out / "views", options.data, network)
        fine_pictures.main(folder, studio, options.pictures)
    torch.manual_seed(options.seed)
    training = FineTraining(options.rate, sorted(folder.glob("[0-9]*.npy")), options.seed)
    training.resume(options.out / "last.pt")
    loop.run(training, training.draw, loop.Budget(options.minutes), options.out)
    return ship(options.out / "last.pt", options.out / "fine.onnx")


class FineTraining(loop.PictureTraining):
    """The fine pass's network in training."""

    schedule = loop.Schedule(hold=0.35, warm_up=30, averaging=0.995)
    held_out, per_step = 24, 4

    def __init__(self, rate: float, files: list[Path], seed: int = 1) -> None:
        super().__init__(fine_model.Network(), rate, files, seed)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """One step on some tiles of each picture."""
        drawn = [tile(taught(file), self.random) for file in batch for _ in range(_TILES)]
        loss = fine_model.loss(*answered(self.network, np.stack(drawn)))
        loss.backward()
        self.update(progress)
        self.samples += len(drawn)
        return {"loss": float(loss.detach())}

    def validate(self, out: Path) -> dict[str, float]:
        """Rms distance of the relief from the truth, and of no relief at all."""
        left, without = [], []
        with self.averaged() as network:
            for file in self.files[: self.held_out]:
                picture = taught(file)
                height, width = (side - side % fine.SIZE_MULTIPLE for side in picture.shape[1:])
                with torch.no_grad():
                    relief, target, known = answered(network, picture[None, :, :height, :width])
                left.append(float((((relief - target) * known) ** 2).sum() / known.sum()))
                without.append(float(((target * known) ** 2).sum() / known.sum()))
        return {"off": float(np.sqrt(np.mean(left))), "off_without": float(np.sqrt(np.mean(without)))}


@cache
def taught(file: Path) -> NDArray[np.float16]:
    """A picture's channels, the relief that should be found (3) and where it is known (1)."""
    picture = np.load(file)
    shown = picture[:_COUNT].astype(np.float32)
    truth, known = picture[_COUNT : _COUNT + 3].astype(np.float32), picture[-1] > 0
    shrink = float(np.exp(shown[-1].max()))
    relief = fine.high_pass(np.moveaxis(truth - shown[_NORMAL : _NORMAL + 3], 0, -1), known, shrink)
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


def answered(network: nn.Module, pictures: Floats) -> tuple[Tensor, Tensor, Tensor]:
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
        "training": f"{state['samples']} tiles of {_TILE} px in {state['step']} steps",
    }  # fmt: skip
    network = fine_model.Network()
    network.load_state_dict(state["average"])
    export.save(network, path, ("relief",), metadata)
    return path


if __name__ == "__main__":
    main(FineTrainingOptions(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4])))
