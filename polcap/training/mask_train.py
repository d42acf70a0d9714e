"""Train the mask's network: `python -m polcap.training.mask_train DATA OUT MINUTES`; goes on where it was stopped.

Pictures are made first, then learned from in two looks a picture: the whole at a quarter of its pixels or a few
more, then a part of it, hinted by what the first look found, or by what a look at the part itself did. Leaves
OUT/mask.onnx, last.pt and metrics.csv.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polcap.images import Floats
from polcap.stages.mask.mask_channels import CHANNELS, ENCODING, SIZE_MULTIPLE, ReducedPicture, brightness, encode
from polcap.training import export, loop, mask_model, mask_pictures

_PARTS, _PART = 4, (96, 128)  # pictures of a step of which a part is shown; its height, width, px
_WHOLE = (80, 96, 112, 128, 144)  # px of the first look's width: drawn for each step
_ZOOM = (0.35, 1.0)  # width of what a part shows, of the picture's
_AGAIN = 0.3  # of the steps look at the parts twice and learn from the second
WHOLE = 112  # px of the longer side at the first look
_LAID = 0.12  # of the pictures have another one's object laid into them


@dataclass(frozen=True)
class MaskTrainingOptions:
    """One training run of the mask's network."""

    data: Path  # holds meshes/ and materials/
    out: Path
    minutes: float = 40.0  # of training, resumed parts included
    pictures: int = 1600
    rate: float = 1.5e-3  # of Muon
    seed: int = 1


def main(options: MaskTrainingOptions) -> Path:
    """Make the pictures that are missing, train, export."""
    mask_pictures.main(options.out / "pictures", options.data, options.pictures)
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    training = MaskTraining(options.rate, sorted((options.out / "pictures").glob("[0-9]*.npy")), options.seed)
    training.resume(options.out / "last.pt")
    loop.run(training, training.draw, loop.Budget(options.minutes), options.out)
    return ship(options.out / "last.pt", options.out / "mask.onnx")


class MaskTraining(loop.PictureTraining):
    """The mask's network in training: a pass over the whole picture, then one over a part of it."""

    schedule = loop.Schedule(hold=0.35, warm_up=50, averaging=0.998)
    held_out, per_step = 40, 8

    def __init__(self, rate: float, files: list[Path], seed: int = 1) -> None:
        super().__init__(mask_model.Network(), rate, files, seed)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """One step; the losses of both passes."""
        rng = self.random
        others = [batch[n - 1] if rng.random() < _LAID else None for n in range(len(batch))]
        drawn = [mask_pictures.drawn(file, rng, other) for file, other in zip(batch, others)]
        width = int(rng.choice(_WHOLE))
        truths = stacked([reduced(truth, width) for _, truth in drawn])
        logits = self.network(stacked_channels([first(look, width) for look, _ in drawn]))
        logits = logits[..., : truths.shape[2], :width]
        whole = mask_model.loss(logits, truths)
        whole.backward()
        chances = torch.sigmoid(logits.detach())[:, 0].numpy()
        parts = [part(look, truth, chance, rng) for (look, truth), chance in zip(drawn[:_PARTS], chances)]
        shown = stacked_channels([seen for seen, _ in parts])
        if rng.random() < _AGAIN:
            with torch.no_grad():
                shown[:, CHANNELS.index("chance")] = 2 * torch.sigmoid(self.network(shown)[:, 0]) - 1
        fine = mask_model.loss(self.network(shown), stacked([truth for _, truth in parts]))
        fine.backward()
        self.update(progress)
        self.samples += len(batch)
        return {"loss_whole": float(whole.detach()), "loss_part": float(fine.detach())}

    def validate(self, out: Path) -> dict[str, float]:
        """IoU of both passes on pictures never learned from; the second pass sees the whole picture."""
        coarse, fine = [], []
        with self.averaged() as network, torch.no_grad():
            for number, file in enumerate(self.files[: self.held_out]):
                look, truth = mask_pictures.drawn(file, np.random.default_rng(number))
                seen = first(look, WHOLE)
                chance = torch.sigmoid(network(stacked_channels([seen])))[0, 0].numpy()
                hint = cv2.resize(
                    chance[: seen.shape[1], : seen.shape[2]], truth.shape[::-1], interpolation=cv2.INTER_LINEAR
                )
                logit = network(stacked_channels([encode(look, brightness(look.color), hint)]))[0, 0].numpy()
                coarse.append(iou(hint > 0.5, truth > 0.5))
                fine.append(iou(logit > 0, truth > 0.5))
        return {"iou_whole": float(np.mean(coarse)), "iou": float(np.mean(fine)), "iou_least": min(fine)}


def first(look: ReducedPicture, width: int) -> Floats:
    """The channels of the whole picture at so many pixels across."""
    smaller = ReducedPicture(
        reduced(look.color, width), np.stack([reduced(s, width) for s in look.stokes]),
        reduced(look.chart.astype(np.float32), width) > 0.5, np.stack([reduced(p, width) for p in look.place]),
    )  # fmt: skip
    return encode(smaller, brightness(smaller.color))


def part(look: ReducedPicture, truth: Floats, chance: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
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

    seen = ReducedPicture(
        cut(look.color), np.stack([cut(s) for s in look.stokes]), cut(look.chart.astype(np.float32)) > 0.5,
        np.stack([cut(p) for p in look.place]),
    )  # fmt: skip
    return encode(seen, brightness(look.color), cut(hint)), cut(truth)


def reduced(image: Floats, width: int) -> Floats:
    """Averaged down to so many pixels across."""
    size = width, round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA))


def stacked_channels(channels: list[Floats]) -> Tensor:
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
        "training": f"{state['samples']} pictures in {state['step']} steps",
    }  # fmt: skip
    network = mask_model.Network()
    network.load_state_dict(state["average"])
    export.save(network, path, ("logit",), metadata)
    return path


if __name__ == "__main__":
    main(MaskTrainingOptions(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])))
