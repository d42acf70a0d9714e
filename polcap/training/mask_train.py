"""Training of the mask's network, and its loss: `python -m polcap.training.mask_train DATA OUT MINUTES`.

Pictures are made first (`mask_pictures.py`). Each step has two passes: over whole pictures at a reduced size, then
over parts of them, with the first result as a hint. A stopped run continues. Writes OUT/mask.onnx, last.pt,
metrics.csv and watch.csv.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from polcap.images import Floats
from polcap.optics.resize import area_mean
from polcap.stages.mask.mask_channels import CHANNELS, ENCODING, SIZE_MULTIPLE, ReducedPicture, brightness, encode
from polcap.training import loop, mask_pictures, unet

_FIRST_WIDTHS = (80, 96, 112, 128, 144)  # px, of pictures in the first pass: one is drawn for each step
_FIRST_WIDTH = 112  # px, in validation and in use
_PARTS, _PART_SIZE = 4, (96, 128)  # pictures of a step in the second pass; height and width of their parts, px
_ZOOM = (0.35, 1.0)  # width of a part, of the picture's
_REPEATED = 0.3  # share of steps with another second pass before, as the source of the hint
_INSERTED = 0.12  # share of pictures into which the object of another one is inserted


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
    """Make the missing pictures, train, export."""
    folder, model = options.out / "pictures", options.out / "mask.onnx"
    mask_pictures.make_pictures(folder, options.data, options.pictures)
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    training = MaskTraining(options.rate, sorted(folder.glob("[0-9]*.npy")), options.seed)
    training.train(options.minutes, options.out)
    training.export(model)
    return model


class MaskTraining(loop.PictureTraining):
    """The mask's network in training."""

    schedule = loop.Schedule(hold=0.35, warm_up=50, averaging=0.998)
    held_out, per_step = 40, 8
    output = "logit"
    metadata: ClassVar[Mapping[str, str]] = {
        "channels": ",".join(CHANNELS), "encoding": ENCODING, "native_size": str(_FIRST_WIDTH),
        "size_multiple": str(SIZE_MULTIPLE), "outputs": "logit: of being the object",
    }  # fmt: skip

    def __init__(self, rate: float, files: list[Path], seed: int = 1) -> None:
        super().__init__(unet.mask_network(), rate, files, seed)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """Do one step; returns the losses of both passes."""
        rng = self.random
        others = [batch[n - 1] if rng.random() < _INSERTED else None for n in range(len(batch))]
        examples = [mask_pictures.load_varied(file, rng, other) for file, other in zip(batch, others)]
        width = int(rng.choice(_FIRST_WIDTHS))
        truths = stack([reduce(truth, width) for _, truth in examples])
        logits = self.network(stack_channels([encode_reduced(picture, width) for picture, _ in examples]))
        logits = logits[..., : truths.shape[2], :width]
        loss_whole = mask_loss(logits, truths)
        loss_whole.backward()
        chances = torch.sigmoid(logits.detach())[:, 0].numpy()
        parts = [cut_part(*example, chance, rng) for example, chance in zip(examples[:_PARTS], chances)]
        channels = stack_channels([channels for channels, _ in parts])
        if rng.random() < _REPEATED:
            with torch.no_grad():
                channels[:, CHANNELS.index("chance")] = 2 * torch.sigmoid(self.network(channels)[:, 0]) - 1
        loss_part = mask_loss(self.network(channels), stack([truth for _, truth in parts]))
        loss_part.backward()
        self.update(progress)
        self.samples += len(batch)
        return {"loss_whole": float(loss_whole.detach()), "loss_part": float(loss_part.detach())}

    def validate(self, out: Path) -> dict[str, float]:
        """IoU of both passes on held-out pictures; here the second pass sees the whole picture."""
        coarse, fine = [], []
        with self.averaged() as network, torch.no_grad():
            for number, file in enumerate(self.files[: self.held_out]):
                picture, truth = mask_pictures.load_varied(file, np.random.default_rng(number))
                channels = encode_reduced(picture, _FIRST_WIDTH)
                chance = torch.sigmoid(network(stack_channels([channels])))[0, 0].numpy()
                hint = cv2.resize(
                    chance[: channels.shape[1], : channels.shape[2]], truth.shape[::-1], interpolation=cv2.INTER_LINEAR
                )
                channels = encode(picture, brightness(picture.color), hint)
                logit = network(stack_channels([channels]))[0, 0].numpy()
                coarse.append(iou(hint > 0.5, truth > 0.5))
                fine.append(iou(logit > 0, truth > 0.5))
        return {"iou_whole": float(np.mean(coarse)), "iou": float(np.mean(fine)), "iou_least": min(fine)}


def mask_loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy plus 0.3 (1 − soft IoU), the mean of the pictures; truth (B, 1, H, W) 0…1.

    Cross entropy makes the probabilities honest.
    """
    entropy = F.binary_cross_entropy_with_logits(logits, truth)
    chance = torch.sigmoid(logits)
    both = (chance * truth).sum(dim=(1, 2, 3))
    either = (chance + truth - chance * truth).sum(dim=(1, 2, 3))
    return entropy + 0.3 * (1 - (both + 1) / (either + 1)).mean()


def encode_reduced(picture: ReducedPicture, width: int) -> Floats:
    """Channels (N, h, width) of the whole picture, reduced."""
    smaller = ReducedPicture(
        reduce(picture.color, width), np.stack([reduce(s, width) for s in picture.stokes]),
        reduce(picture.chart.astype(np.float32), width) > 0.5, np.stack([reduce(p, width) for p in picture.place]),
    )  # fmt: skip
    return encode(smaller, brightness(smaller.color))


def cut_part(picture: ReducedPicture, truth: Floats, chance: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Channels and truth of a rectangle near the outline; the hint is `chance` (h, w), the result of the first pass.

    Four in ten are placed where the first pass is wrong.
    """
    height, width = truth.shape
    zoom = rng.uniform(*_ZOOM)
    tall, wide = int(height * zoom), int(width * zoom)
    hint = cv2.resize(chance, (width, height), interpolation=cv2.INTER_LINEAR)
    solid = (truth > 0.5).astype(np.uint8)
    outline = np.argwhere((solid > 0) & (cv2.erode(solid, np.ones((3, 3), np.uint8), borderValue=1) == 0))
    wrong = np.argwhere((hint > 0.5) != (solid > 0))
    places = wrong if len(wrong) and rng.random() < 0.4 else outline
    y, x = places[rng.integers(len(places))] if len(places) else (height // 2, width // 2)
    y, x = (
        int(np.clip(a - rng.uniform(0.2, 0.8) * side, 0, n - side))
        for a, n, side in ((y, height, tall), (x, width, wide))
    )
    kind = cv2.INTER_AREA if tall > _PART_SIZE[0] else cv2.INTER_LINEAR

    def cut(image: Floats) -> Floats:
        part = np.ascontiguousarray(image[y : y + tall, x : x + wide])
        return np.asarray(cv2.resize(part, _PART_SIZE[::-1], interpolation=kind))

    part = ReducedPicture(
        cut(picture.color), np.stack([cut(s) for s in picture.stokes]), cut(picture.chart.astype(np.float32)) > 0.5,
        np.stack([cut(p) for p in picture.place]),
    )  # fmt: skip
    return encode(part, brightness(picture.color), cut(hint)), cut(truth)


def reduce(image: Floats, width: int) -> Floats:
    """Area means of an image (H, W, ·) at `width` pixels across."""
    return area_mean(np.asarray(image, np.float32), (round(image.shape[0] * width / image.shape[1]), width))


def stack_channels(channels: list[Floats]) -> Tensor:
    """Batch of channels (N, H, W) of one size; the edge is repeated up to a size that the network takes."""
    more = [(0, -side % SIZE_MULTIPLE) for side in channels[0].shape[1:]]
    padded = np.pad(np.stack(channels), [(0, 0), (0, 0), *more], mode="edge")
    return torch.from_numpy(padded).contiguous(memory_format=torch.channels_last)


def stack(truths: list[Floats]) -> Tensor:
    return torch.from_numpy(np.stack(truths)[:, None].astype(np.float32))


def iou(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    return float((found & truth).sum() / max((found | truth).sum(), 1))


if __name__ == "__main__":
    main(MaskTrainingOptions(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])))
