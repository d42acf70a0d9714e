"""Training of the refinement network, and its loss: `python -m polcap.training.fine_train DATA MODEL OUT MINUTES`.

MODEL is the file of the main network. Pictures are made first (`fine_pictures.py`), then tiles of them are learned.
A stopped run continues. Writes OUT/fine.onnx, last.pt, metrics.csv and watch.csv.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from polcap.formats import onnx
from polcap.images import Floats
from polcap.stages.infer import fine
from polcap.training import fine_pictures, loop, unet

_TILES, _TILE = 4, 96  # tiles of a picture in a step; their side, px
_DOUBLE_ANGLES = tuple(fine.CHANNELS.index(name) for name in ("s1", "zenith_x", "cos_2phi"))  # first of two channels
_VECTORS = tuple(fine.CHANNELS.index(name) for name in ("ray_x", "normal_x", "smooth_x"))  # first of the channels
_NORMAL, _COUNT = fine.CHANNELS.index("normal_x"), len(fine.CHANNELS)


@dataclass(frozen=True)
class FineTrainingOptions:
    """One training run of the refinement network."""

    data: Path  # holds meshes/ and materials/
    model: Path  # of the main network
    out: Path
    minutes: float = 40.0  # of training, resumed parts included
    pictures: int = 400
    rate: float = 2e-3  # of Muon
    seed: int = 1


def main(options: FineTrainingOptions) -> Path:
    """Make the missing pictures, train, export."""
    torch.set_num_threads(1)
    folder, model = options.out / "pictures", options.out / "fine.onnx"
    if len(list(folder.glob("[0-9]*.npy"))) < options.pictures:
        network = onnx.load(options.model, threads=1)
        maker = fine_pictures.FinePictureMaker.open(options.out / "views", options.data, network)
        fine_pictures.make_pictures(folder, maker, options.pictures)
    torch.manual_seed(options.seed)
    training = FineTraining(options.rate, sorted(folder.glob("[0-9]*.npy")), options.seed)
    training.train(options.minutes, options.out)
    training.export(model)
    return model


class FineTraining(loop.PictureTraining):
    """The refinement network in training."""

    schedule = loop.Schedule(hold=0.35, warm_up=30, averaging=0.995)
    held_out, per_step = 24, 4
    output = "relief"
    metadata: ClassVar[Mapping[str, str]] = {
        "channels": ",".join(fine.CHANNELS), "encoding": fine.ENCODING, "native_size": str(fine_pictures.SIDE),
        "size_multiple": str(fine.SIZE_MULTIPLE), "outputs": "relief: added to the first normal, in each ray's frame",
    }  # fmt: skip

    def __init__(self, rate: float, files: list[Path], seed: int = 1) -> None:
        super().__init__(unet.fine_network(), rate, files, seed)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """Do one step on some tiles of each picture; returns the loss."""
        tiles = [cut_tile(load_example(file), self.random) for file in batch for _ in range(_TILES)]
        loss = fine_loss(*predict(self.network, np.stack(tiles)))
        loss.backward()
        self.update(progress)
        self.samples += len(tiles)
        return {"loss": float(loss.detach())}

    def validate(self, out: Path) -> dict[str, float]:
        """RMS error of the estimated relief, `off`, and of zero relief, `off_without`, on held-out pictures."""
        squares, squares_without = [], []
        with self.averaged() as network:
            for file in self.files[: self.held_out]:
                picture = load_example(file)
                height, width = (side - side % fine.SIZE_MULTIPLE for side in picture.shape[1:])
                with torch.no_grad():
                    relief, target, known = predict(network, picture[None, :, :height, :width])
                squares.append(float((((relief - target) * known) ** 2).sum() / known.sum()))
                squares_without.append(float(((target * known) ** 2).sum() / known.sum()))
        return {"off": float(np.sqrt(np.mean(squares))), "off_without": float(np.sqrt(np.mean(squares_without)))}


def fine_loss(relief: Tensor, target: Tensor, known: Tensor) -> Tensor:
    """Squared distance plus half the distance between relief and target (B, 3, H, W), where `known` (B, 1, H, W)."""
    square = (relief - target).square().sum(dim=1, keepdim=True)
    return ((square + 0.5 * (square + 1e-4).sqrt()) * known).sum() / known.sum().clamp(min=1)


@cache
def load_example(file: Path) -> NDArray[np.float16]:
    """A picture's channels, its target relief (3 channels) and the mask of known relief (1 channel)."""
    picture = np.load(file)
    channels = picture[:_COUNT].astype(np.float32)
    truth, known = picture[_COUNT : _COUNT + 3].astype(np.float32), picture[-1] > 0
    shrink = float(np.exp(channels[-1].max()))
    relief = fine.high_pass(np.moveaxis(truth - channels[_NORMAL : _NORMAL + 3], 0, -1), known, shrink)
    return np.concatenate([picture[:_COUNT], np.moveaxis(relief, -1, 0), known[None]]).astype(np.float16)


def cut_tile(picture: NDArray[np.float16], rng: np.random.Generator) -> Floats:
    """A square (C, 96, 96) about a random pixel of the object, rotated and mirrored at random."""
    inside = np.flatnonzero(picture[-1])
    y, x = divmod(int(inside[rng.integers(len(inside))]), picture.shape[2])
    pad = _TILE // 2
    top, left = max(0, pad - y), max(0, pad - x)
    part = picture[:, max(0, y - pad) : y + pad, max(0, x - pad) : x + pad]
    out = np.zeros((len(picture), _TILE, _TILE), np.float32)
    out[:, top : top + part.shape[1], left : left + part.shape[2]] = part
    return rotate(out, int(rng.integers(4)), bool(rng.integers(2)))


def rotate(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """The picture of a scene mirrored left to right, then turned counter-clockwise by quarter turns.

    Pixels (C, H, W) move, and so do the vectors and doubled angles in the channels.
    """
    out = np.array(np.rot90(picture[..., ::-1] if mirror else picture, quarters, axes=(1, 2)))
    for first in _DOUBLE_ANGLES:  # a quarter turn negates both channels, a mirror the second
        out[first : first + 2] *= (-1.0) ** quarters
        out[first + 1] *= -1.0 if mirror else 1.0
    for first in (*_VECTORS, _COUNT):
        x, y = (-out[first] if mirror else out[first].copy()), out[first + 1].copy()
        for _ in range(quarters):
            x, y = -y, x
        out[first], out[first + 1] = x, y
    return out


def predict(network: nn.Module, pictures: Floats) -> tuple[Tensor, Tensor, Tensor]:
    """Estimated relief, target relief and mask of known relief of pictures (B, N + 4, H, W)."""
    batch = torch.from_numpy(pictures.astype(np.float32))
    channels = batch[:, :_COUNT].contiguous(memory_format=torch.channels_last)
    return network(channels), batch[:, _COUNT : _COUNT + 3], batch[:, _COUNT + 3 :]


if __name__ == "__main__":
    main(FineTrainingOptions(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4])))
