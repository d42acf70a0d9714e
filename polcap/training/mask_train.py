"""Train the mask's network: `python -m polcap.training.mask_train DATA OUT MINUTES`; goes on where it was stopped.

Pictures are made first, then learned from in two looks a picture: the whole at a quarter of its pixels or a few
more, then a part of it, hinted by what the first look found, or by what a look at the part itself did. Leaves
OUT/mask.onnx, last.pt and metrics.csv.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polcap.images import Floats
from polcap.stages.mask.mask_channels import CHANNELS, ENCODING, SIZE_MULTIPLE, Look, brightness, encode
from polcap.training import export, mask_model, mask_pictures
from polcap.training.small_run import SmallRun

_BATCH, _PARTS, _PART = 8, 4, (96, 128)  # pictures a step, of how many a part is looked at; its height, width, px
_WHOLE = (80, 96, 112, 128, 144)  # px of the first look's width: drawn for each step
_ZOOM = (0.35, 1.0)  # width of what a part shows, of the picture's
_AGAIN = 0.3  # of the steps look at the parts twice and learn from the second
WHOLE = 112  # px of the longer side at the first look
_HELD = 40  # pictures that are only looked at
_LAID = 0.12  # of the pictures have another one's object laid into them


@dataclass(frozen=True)
class Params:
    """What one training run is told."""

    data: Path  # holds meshes/ and materials/
    out: Path
    minutes: float = 40.0  # of training, resumed parts together
    pictures: int = 1600
    rate: float = 1.5e-3  # of Muon; half of it for AdamW
    seed: int = 1


def main(params: Params) -> Path:
    """Make the pictures that are missing, train, export."""
    mask_pictures.main(params.out / "pictures", params.data, params.pictures)
    files = sorted((params.out / "pictures").glob("[0-9]*.npy"))
    torch.set_num_threads(1)
    torch.manual_seed(params.seed)
    run = Run(params.rate)
    run.spend(params.minutes, files, _HELD, _BATCH, params.seed, params.out)
    return ship(params.out / "last.pt", params.out / "mask.onnx")


class Run(SmallRun):
    """The network in training, by its own pictures."""

    made, warm, keep = mask_model.Network, 50, 0.998

    def advance(self, files: list[Path], progress: float, rng: np.random.Generator) -> tuple[float, float]:
        """One step; the two looks' losses."""
        self.pace(progress)
        others = [files[n - 1] if rng.random() < _LAID else None for n in range(len(files))]
        drawn = [mask_pictures.drawn(file, rng, other) for file, other in zip(files, others)]
        width = int(rng.choice(_WHOLE))
        truths = stacked([reduced(truth, width) for _, truth in drawn])
        logits = self.network(batch([first(look, width) for look, _ in drawn]))[..., : truths.shape[2], :width]
        coarse = mask_model.loss(logits, truths)
        coarse.backward()
        chances = torch.sigmoid(logits.detach())[:, 0].numpy()
        parts = [part(look, truth, chance, rng) for (look, truth), chance in zip(drawn[:_PARTS], chances)]
        shown = batch([seen for seen, _ in parts])
        if rng.random() < _AGAIN:
            with torch.no_grad():
                shown[:, CHANNELS.index("chance")] = 2 * torch.sigmoid(self.network(shown)[:, 0]) - 1
        fine = mask_model.loss(self.network(shown), stacked([t for _, t in parts]))
        fine.backward()
        self.learn()
        return float(coarse.detach()), float(fine.detach())

    def look(self, path: Path, losses: Any, files: list[Path]) -> None:
        """A row of metrics."""
        _record(path, self, losses, *self.judge(files))

    def judge(self, files: list[Path]) -> tuple[Floats, Floats]:
        """IoU of both looks of the averaged weights on pictures never learned from; the second at the whole picture."""
        network = averaged(self.average)
        found: tuple[list[float], list[float]] = [], []
        for number, file in enumerate(files):
            look, truth = mask_pictures.drawn(file, np.random.default_rng(number))
            with torch.no_grad():
                seen = first(look, WHOLE)
                chance = torch.sigmoid(network(batch([seen])))[0, 0].numpy()[: seen.shape[1], : seen.shape[2]]
                hint = cv2.resize(chance, truth.shape[::-1], interpolation=cv2.INTER_LINEAR)
                fine = network(batch([encode(look, brightness(look.color), hint)]))[0, 0].numpy()
            found[0].append(iou(hint > 0.5, truth > 0.5))
            found[1].append(iou(fine > 0, truth > 0.5))
        return np.array(found[0]), np.array(found[1])


def averaged(weights: dict[str, Tensor]) -> mask_model.Network:
    network = mask_model.Network()
    network.load_state_dict(weights)
    network.eval()
    return network


def first(look: Look, width: int) -> Floats:
    """The channels of the whole picture at so many pixels across."""
    smaller = Look(
        reduced(look.color, width), np.stack([reduced(s, width) for s in look.stokes]),
        reduced(look.chart.astype(np.float32), width) > 0.5, np.stack([reduced(p, width) for p in look.place]),
    )  # fmt: skip
    return encode(smaller, brightness(smaller.color))


def part(look: Look, truth: Floats, chance: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The channels of a rectangle about a place of the outline, hinted, and its truth."""
    height, width = truth.shape
    zoom = rng.uniform(*_ZOOM)
    tall, wide = int(height * zoom), int(width * zoom)
    hint = cv2.resize(chance, (width, height), interpolation=cv2.INTER_LINEAR)
    solid = (truth > 0.5).astype(np.uint8)
    rim = np.argwhere((solid > 0) & (cv2.erode(solid, np.ones((3, 3), np.uint8), borderValue=1) == 0))
    wrong = np.argwhere((hint > 0.5) != (solid > 0))
    places = wrong if len(wrong) and rng.random() < 0.4 else rim
    y, x = places[rng.integers(len(places))] if len(places) else (height // 2, width // 2)
    y, x = (
        int(np.clip(a - rng.uniform(0.2, 0.8) * side, 0, n - side))
        for a, n, side in ((y, height, tall), (x, width, wide))
    )
    kind = cv2.INTER_AREA if tall > _PART[0] else cv2.INTER_LINEAR

    def cut(image: Floats) -> Floats:
        shown = np.ascontiguousarray(image[y : y + tall, x : x + wide])
        return np.asarray(cv2.resize(shown, _PART[::-1], interpolation=kind))

    seen = Look(
        cut(look.color), np.stack([cut(s) for s in look.stokes]), cut(look.chart.astype(np.float32)) > 0.5,
        np.stack([cut(p) for p in look.place]),
    )  # fmt: skip
    return encode(seen, brightness(look.color), cut(hint)), cut(truth)


def reduced(image: Floats, width: int) -> Floats:
    """Averaged down to so many pixels across."""
    size = width, round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA))


def batch(channels: list[Floats]) -> Tensor:
    """Channels of pictures of one size, the edge repeated up to what the network takes."""
    more = [(0, -side % SIZE_MULTIPLE) for side in channels[0].shape[1:]]
    padded = np.pad(np.stack(channels), [(0, 0), (0, 0), *more], mode="edge")
    return torch.from_numpy(padded).contiguous(memory_format=torch.channels_last)


def stacked(truths: list[Floats]) -> Tensor:
    return torch.from_numpy(np.stack(truths)[:, None].astype(np.float32))


def iou(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    return float((found & truth).sum() / max((found | truth).sum(), 1))


def ship(checkpoint: Path, path: Path) -> Path:
    """The averaged weights of a checkpoint as the model that `formats/onnx.py` loads."""
    state = torch.load(checkpoint, weights_only=True)
    metadata = {
        "channels": ",".join(CHANNELS), "encoding": ENCODING, "native_size": str(WHOLE),
        "size_multiple": str(SIZE_MULTIPLE), "licence": "Apache-2.0", "outputs": "logit: of being the object",
        "training": f"{state['step'] * _BATCH} pictures in {state['step']} steps",
    }  # fmt: skip
    export.save(averaged(state["average"]), path, ("logit",), metadata)
    return path


def _record(path: Path, run: Run, losses: Floats, coarse: Floats, fine: Floats) -> None:
    row = {
        "step": run.step, "seconds": round(run.elapsed), "loss_whole": losses[0], "loss_part": losses[1],
        "iou_whole": coarse.mean(), "iou": fine.mean(), "iou_least": fine.min(),
    }  # fmt: skip
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if fresh:
            writer.writeheader()
        writer.writerow({k: f"{v:.4g}" for k, v in row.items()})
    print(" ".join(f"{k} {v:.4g}" for k, v in row.items()), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(Params(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])))
