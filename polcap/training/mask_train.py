"""Training of the mask network: `python -m polcap.training.mask_train DATA OUT MINUTES`.

First the training pictures are made; each is determined by its number. A training step reads some of them, with random
light, noise and crop. It has two passes: over whole pictures at a reduced size, then over parts of them, with the first
result as a hint. A stopped run continues. Writes OUT/mask.onnx, last.pt, metrics.csv and watch.csv. A picture file
OUT/pictures/000017.npy has (H, W, 7) fp16: S0 in linear Rec.709, S1 and S2 summed over colors, object, chart.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from polcap.formats import atomic
from polcap.image_values import Floats
from polcap.optics.mesh_tracer import Tracer, Triangles, centred
from polcap.optics.resize import area_mean, block_means
from polcap.stages.mask.mask_channels import CHANNELS, ENCODING, SIZE_MULTIPLE, ReducedPicture, brightness, encode
from polcap.training import loop, mask_scenes, mask_views, materials, random_shapes, traced_views, unet
from polcap.training.onnx_export import UNSTATED

_PICTURES, _SIZE = 1600, (288, 384)  # H, W, traced; files have half of it
_OBJECT, _CHART = 5, 6  # layers of a file: masks, after three colors, S1 and S2
_VIEWS, _SCENES = 3, 2  # views of each mesh, scenes of each view
_MISSED = 0.15  # share of charts that are in the picture but not found
_RATE = 1.5e-3  # of Muon
_FIRST_WIDTHS = (80, 96, 112, 128, 144)  # px, of pictures in the first pass: one is drawn for each step
_FIRST_WIDTH = 112  # px, in validation and in use
_PARTS, _PART_SIZE = 4, (96, 128)  # pictures of a step in the second pass; height and width of their parts, px
_ZOOM = (0.35, 1.0)  # width of a part, of the picture's
_REPEATED = 0.3  # share of steps with two second passes; the first of them gives the hint
_INSERTED = 0.12  # share of pictures into which the object of another one is inserted


def main(data: Path, out: Path, minutes: float, licence: str = UNSTATED) -> None:
    """Train the mask network: make the missing pictures, train for `minutes`, export."""
    torch.set_num_threads(1)
    make_pictures(out / "pictures", data, _PICTURES)
    torch.manual_seed(1)
    training = MaskTraining(_RATE, sorted((out / "pictures").glob("[0-9]*.npy")))
    training.train(minutes, out)
    training.export(out / "mask.onnx", licence)


def make_pictures(out: Path, data: Path, count: int) -> None:
    """Make the training pictures 0…count − 1 that the folder lacks, from the training meshes and materials."""
    files = traced_views.training_meshes(data)
    library = materials.MaterialLibrary(data / "materials" / "train", torch.device("cpu"))
    each = _VIEWS * _SCENES
    for group in range(-(-count // each)):
        paths = [out / f"{number:06d}.npy" for number in range(group * each, (group + 1) * each)]
        if all(path.exists() for path in paths):
            continue
        for path, picture in zip(paths, _make_group(files, library, group)):
            with atomic.path(path) as temporary:
                np.save(temporary, picture)


def _make_group(files: list[Path], library: materials.MaterialLibrary, group: int) -> Iterator[Floats]:
    """Simulated pictures of one object; in a quarter of the groups, of two or three objects side by side."""
    rng = np.random.default_rng([5, group])  # 5: an arbitrary seed
    torch.manual_seed(int(rng.integers(1 << 62)))
    if rng.random() < 0.75:
        mesh = _draw_mesh(files, rng)
    else:
        mesh = mask_views.side_by_side([_draw_mesh(files, rng) for _ in range(rng.integers(2, 4))], rng)
    tracer, made = Tracer(mesh), 0
    while made < _VIEWS:
        view = mask_views.trace_view(tracer, mask_views.draw_kind(rng), _SIZE, rng)
        if view is None:
            continue
        made += 1
        for _ in range(_SCENES):
            mode = rng.choice(list(mask_scenes.MODES), p=list(mask_scenes.MODES.values()))
            yield pack(mask_scenes.make_scene(view, library, mode, rng))


def _draw_mesh(files: list[Path], rng: np.random.Generator) -> Triangles:
    """A random mesh for a training picture: a scanned mesh, or a random shape with or without branches."""
    kind = rng.random()
    if kind < 0.4:
        return centred(traced_views.read_mesh(files[rng.integers(len(files))]))
    return random_shapes.compose(rng) if kind < 0.7 else random_shapes.compose_with_branches(rng)


def pack(picture: mask_scenes.MaskScene) -> Floats:
    """Layers (H/2, W/2, 7) of a training picture file: means of 2 × 2 pixels, radiance over its 95th percentile."""
    stokes = picture.stokes / max(float(np.percentile(picture.stokes[0].mean(-1), 95)), 1e-9)
    sums = np.moveaxis(stokes[1:].sum(-1), 0, -1)
    layers = np.concatenate([stokes[0], sums, picture.mask[..., None], picture.chart[..., None]], axis=-1)
    return block_means(np.clip(layers, -6e4, 6e4), 2).astype(np.float16)  # within the range of fp16


def load_varied(file: Path, rng: np.random.Generator, other: Path | None = None) -> tuple[ReducedPicture, Floats]:
    """Read a training picture with random light, crop, mirroring and noise; returns it and its true mask (H, W).

    `other` is the file of another picture; its object is inserted into this one.
    """
    layers = np.load(file).astype(np.float32)
    if other is not None:
        second = np.load(other).astype(np.float32)
        second[..., _CHART] = 0
        inserted = (second[..., _OBJECT] > 0.5) & (layers[..., _CHART] < 0.5)
        layers = np.where(inserted[..., None], second, layers)
    layers = _crop(layers, rng)
    stokes, mask, chart = layers[..., :_OBJECT], layers[..., _OBJECT], layers[..., _CHART] > 0.5
    if not chart.any() and rng.random() < 0.3:  # other colors; those of a chart stay
        stokes = stokes[..., [*rng.permutation(3), 3, 4]]
    if rng.random() < 0.5:  # mirrored, which negates S2
        stokes, mask, chart = stokes[:, ::-1] * [1, 1, 1, 1, -1], mask[:, ::-1], chart[:, ::-1]
    if rng.random() < 0.1:  # camera upside down
        stokes, mask, chart = stokes[::-1] * [1, 1, 1, 1, -1], mask[::-1], chart[::-1]
    light = np.exp(rng.normal(0, 0.25)) * mask + np.exp(rng.normal(0, 0.25)) * (1 - mask)
    light = light * (1 - chart) + chart  # that of the chart is 1
    tint = np.exp(rng.normal(0, 0.1, (2, 3)))
    color = stokes[..., :3] * light[..., None] * np.where((mask > 0)[..., None], tint[0], tint[1])
    sums = np.stack([color.sum(-1), *(np.moveaxis(stokes[..., 3:], -1, 0) * light * rng.uniform(0.6, 1.1))])
    if rng.random() < _MISSED:
        chart = np.zeros_like(chart)
    return mask_scenes.simulate_measurement(color, sums, chart, rng), mask


def _crop(layers: Floats, rng: np.random.Generator) -> Floats:
    """Crop a picture (H, W, 7) at random, in half of the cases.

    The crop contains enough of the object, and is enlarged to the old size.
    """
    height, width = layers.shape[:2]
    for _ in range(4 if rng.random() < 0.5 else 0):
        share = rng.uniform(0.6, 0.95)
        tall, wide = int(height * share), int(width * share)
        y, x = rng.integers(height - tall + 1), rng.integers(width - wide + 1)
        part = layers[y : y + tall, x : x + wide]
        if 0.01 < part[..., _OBJECT].mean() < 0.9:
            return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR))
    return layers


class MaskTraining(loop.PictureTraining):
    """Training of the mask network: weights, optimizers and pictures."""

    hold, warm_up, averaging = 0.35, 50, 0.998
    held_out, per_step = 40, 8
    output = "logit"
    metadata: ClassVar[Mapping[str, str]] = {
        "channels": ",".join(CHANNELS), "encoding": ENCODING, "native_size": str(_FIRST_WIDTH),
        "size_multiple": str(SIZE_MULTIPLE), "outputs": "logit: of being the object",
    }  # fmt: skip

    def __init__(self, rate: float, files: list[Path]) -> None:
        super().__init__(unet.mask_network(), rate, files)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """One training step on picture files; returns the losses of both passes (whole picture, then parts)."""
        rng = self.random
        inserted = [batch[n - 1] if rng.random() < _INSERTED else None for n in range(len(batch))]
        examples = [load_varied(file, rng, other) for file, other in zip(batch, inserted)]
        width = int(rng.choice(_FIRST_WIDTHS))
        truths = _stack([_reduce(truth, width) for _, truth in examples])
        logits = self.network(_stack_channels([_encode_reduced(picture, width) for picture, _ in examples]))
        logits = logits[..., : truths.shape[2], :width]  # without the padding of `_stack_channels`
        loss_whole = mask_loss(logits, truths)
        loss_whole.backward()
        hints = torch.sigmoid(logits.detach())[:, 0].numpy()
        parts = [_cut_part(*example, hint, rng) for example, hint in zip(examples[:_PARTS], hints)]
        channels = _stack_channels([channels for channels, _ in parts])
        if rng.random() < _REPEATED:
            with torch.no_grad():  # the channel "chance" has the hint in −1…1
                channels[:, CHANNELS.index("chance")] = 2 * torch.sigmoid(self.network(channels)[:, 0]) - 1
        loss_part = mask_loss(self.network(channels), _stack([truth for _, truth in parts]))
        loss_part.backward()
        self.update(progress)
        self.samples += len(batch)
        return {"loss_whole": float(loss_whole.detach()), "loss_part": float(loss_part.detach())}

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def validate(self, out: Path) -> dict[str, float]:
        """Intersection over union (IoU) of the masks on held-out pictures, for both passes over whole pictures."""
        rows = []
        for number, file in enumerate(self.files[: self.held_out]):
            picture, truth = load_varied(file, np.random.default_rng(number))
            channels = _encode_reduced(picture, _FIRST_WIDTH)
            chance = torch.sigmoid(self.average(_stack_channels([channels])))[0, 0].numpy()
            hint = cv2.resize(chance[: channels.shape[1], : channels.shape[2]], truth.shape[::-1])
            logit = self.average(_stack_channels([encode(picture, brightness(picture.color), hint)]))[0, 0].numpy()
            object_ = truth > 0.5
            rows.append([(m & object_).sum() / max((m | object_).sum(), 1) for m in (hint > 0.5, logit > 0)])
        coarse, fine = np.array(rows).T
        return {"iou_whole": float(coarse.mean()), "iou": float(fine.mean()), "iou_least": float(fine.min())}


def mask_loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Loss of mask logits: cross entropy plus 0.3 (1 − soft IoU), mean over the pictures; truth (B, 1, H, W) 0…1.

    Cross entropy is least for true probabilities; soft IoU counts whole objects. Its weight was chosen by hand. One
    pixel is added to intersection and union, so that a picture without an object gives no 0/0.
    """
    entropy = F.binary_cross_entropy_with_logits(logits, truth)
    chance = torch.sigmoid(logits)
    both = (chance * truth).sum(dim=(1, 2, 3))
    either = (chance + truth - chance * truth).sum(dim=(1, 2, 3))
    return entropy + 0.3 * (1 - (both + 1) / (either + 1)).mean()


def _encode_reduced(picture: ReducedPicture, width: int) -> Floats:
    """Input channels (N, h, width) of the mask network for the whole picture, reduced to `width`."""
    smaller = _map_layers(picture, lambda image: _reduce(image, width))
    return encode(smaller, brightness(smaller.color))


def _cut_part(
    picture: ReducedPicture, truth: Floats, chance: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Cut a rectangle near the outline for the second pass: its input channels and true mask.

    `chance` (h, w) is the probability from the first pass; it becomes the hint channel. Four in ten rectangles are
    placed where the first pass is wrong.
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
    y = int(np.clip(y - rng.uniform(0.2, 0.8) * tall, 0, height - tall))
    x = int(np.clip(x - rng.uniform(0.2, 0.8) * wide, 0, width - wide))
    kind = cv2.INTER_AREA if tall > _PART_SIZE[0] else cv2.INTER_LINEAR

    def cut(image: Floats) -> Floats:
        part = np.ascontiguousarray(image[y : y + tall, x : x + wide])
        return np.asarray(cv2.resize(part, _PART_SIZE[::-1], interpolation=kind))

    return encode(_map_layers(picture, cut), brightness(picture.color), cut(hint)), cut(truth)


def _map_layers(picture: ReducedPicture, change: Callable[[Floats], Floats]) -> ReducedPicture:
    """A reduced picture with the function `change` applied to each of its images."""
    chart = change(picture.chart.astype(np.float32)) > 0.5
    stokes, place = (np.stack([change(layer) for layer in layers]) for layers in (picture.stokes, picture.place))
    return ReducedPicture(change(picture.color), stokes, chart, place)


def _reduce(image: Floats, width: int) -> Floats:
    """Reduce an image (H, W, ·) to `width` pixels across by area means."""
    return area_mean(np.asarray(image, np.float32), (round(image.shape[0] * width / image.shape[1]), width))


def _stack_channels(channels: list[Floats]) -> Tensor:
    """Stack channels (N, H, W) into a batch; the edge is repeated up to a size that the network accepts."""
    padding = [(0, -side % SIZE_MULTIPLE) for side in channels[0].shape[1:]]
    padded = np.pad(np.stack(channels), [(0, 0), (0, 0), *padding], mode="edge")
    return torch.from_numpy(padded).contiguous(memory_format=torch.channels_last)


def _stack(truths: list[Floats]) -> Tensor:
    return torch.from_numpy(np.stack(truths)[:, None].astype(np.float32))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), *sys.argv[4:5])
