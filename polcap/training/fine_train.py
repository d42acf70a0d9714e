"""Training of the refinement network: `python -m polcap.training.fine_train DATA MODEL OUT MINUTES`.

MODEL is the file of the main network. First the training pictures are made: traced views get a random relief, are
photographed, and pass through the main network. Then the network is trained on tiles of these pictures. A stopped run
continues. Writes OUT/fine.onnx, last.pt, metrics.csv and watch.csv. A picture file has (N + 4, H, W) fp16: the channels
of `stages/infer/fine.py` (N), the true normal in the frame of each ray (3), the mask of known normals (1).
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from polcap.formats import atomic, onnx
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.stage_values import Network
from polcap.stages import cues
from polcap.stages.infer import fine, learned
from polcap.training import evaluation_protocol, loop, materials, relief, traced_views, unet
from polcap.training.camera_errors import CameraErrors
from polcap.training.onnx_export import UNSTATED
from polcap.training.simulator import Simulator

_PICTURES = 400
_SIDE = 448  # px
_RECIPE = traced_views.ViewsRecipe(views=2, procedural=14, size=_SIDE, seed=51, per_shape=4)
_FIRST_SIZES = (80, 400)  # px of the longer side at which the main network sees a picture
_IOR = 1.5
_SHIFT = 2.5  # factor on the misregistration of the main network's training, which has larger pixels
_RATE = 2e-3  # of Muon
_TILES, _TILE = 4, 96  # tiles of a picture in a step; their side, px
_DOUBLE_ANGLES = tuple(fine.CHANNELS.index(name) for name in ("s1", "zenith_x", "cos_2phi"))  # first of two channels
_VECTORS = tuple(fine.CHANNELS.index(name) for name in ("ray_x", "normal_x", "smooth_x"))  # first of the channels
_NORMAL, _INPUTS = fine.CHANNELS.index("normal_x"), len(fine.CHANNELS)


def main(data: Path, model: Path, out: Path, minutes: float, licence: str = UNSTATED) -> None:
    """Train the refinement network: make the missing pictures, train for `minutes`, export."""
    torch.set_num_threads(1)
    files = [out / "pictures" / f"{number:05d}.npy" for number in range(_PICTURES)]
    if not all(file.exists() for file in files):
        network = onnx.load(model, threads=1)
        library = materials.MaterialLibrary(data / "materials" / "train", torch.device("cpu"))
        views = traced_views.open_cache(out / "views", traced_views.training_meshes(data), _RECIPE)
        # light from the flash alone, because the cache indexes bounces only up to 256² pixels (decision 29)
        simulator = Simulator(views, library, torch.device("cpu"), bounces=False)
        for number, path in enumerate(files):
            if not path.exists():
                with atomic.path(path) as temporary:
                    np.save(temporary, make_picture(simulator, network, number))
    torch.manual_seed(1)
    training = FineTraining(_RATE, files)
    training.train(minutes, out)
    training.export(out / "fine.onnx", licence)


def make_picture(simulator: Simulator, network: Network, number: int) -> NDArray[np.float16]:
    """Simulate a photograph of a traced view with random relief: layers of a picture file, cropped to the object."""
    rng = np.random.default_rng([_RECIPE.seed, number])
    view = number % len(simulator.camera)
    focal, x, y, middle = (float(value) for value in simulator.camera[view, :4])
    with torch.random.fork_rng():
        torch.manual_seed(number)
        views = simulator.gather(np.array([view]), _SIDE, flip=False)
        pixels = views.pixels
        slope = relief.random_slopes(pixels.position.numpy(), middle / focal, rng) @ views.turn[0].numpy().T
        normal = torch.from_numpy(frames.unit(frames.tilted(pixels.normal.numpy(), slope)))
        errors = CameraErrors.draw(1, normal.device)
        errors = replace(errors, shift=_SHIFT * errors.shift)
        photo = simulator.photograph(replace(views, pixels=replace(pixels, normal=normal)), torch.ones(1), errors)
    mask = photo.input_mask[0].numpy()
    measured = (photo.stokes, photo.covariance, photo.clipped)
    image = evaluation_protocol.stokes_image(measured, mask, View(focal, (x, y), scale=1.0))
    estimated = cues.compute(image, evaluation_protocol.white())
    size = int(_FIRST_SIZES[0] * (_FIRST_SIZES[1] / _FIRST_SIZES[0]) ** rng.random())
    network = replace(network, metadata={**network.metadata, "native_size": str(size)})
    _, guess, _ = learned.estimate_coarse(estimated, network, onnx.run, _IOR, 1)
    truth = np.moveaxis(photo.truth["normal"][0].numpy(), -1, 0)
    known = (photo.mask[0].numpy() & mask)[None]
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    crop = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    layers: Floats = np.concatenate([fine.encode(estimated, guess), truth, known])
    return np.ascontiguousarray(layers[crop].astype(np.float16))


class FineTraining(loop.PictureTraining):
    """Training of the refinement network: weights, optimizers and pictures."""

    hold, warm_up, averaging = 0.35, 30, 0.995
    held_out, per_step = 24, 4
    output = "relief"
    metadata: ClassVar[Mapping[str, str]] = {
        "channels": ",".join(fine.CHANNELS), "encoding": fine.ENCODING, "native_size": str(_SIDE),
        "size_multiple": str(fine.SIZE_MULTIPLE), "outputs": "relief: added to the first normal, in each ray's frame",
    }  # fmt: skip

    def __init__(self, rate: float, files: list[Path]) -> None:
        super().__init__(unet.fine_network(), rate, files)

    def advance(self, batch: list[Path], progress: float) -> dict[str, float]:
        """One training step on some tiles of each picture file of the batch; returns the loss."""
        tiles = [cut_tile(load_example(file), self.random) for file in batch for _ in range(_TILES)]
        relief, target, known = _predict(self.network, np.stack(tiles))
        square = (relief - target).square().sum(dim=1, keepdim=True)
        loss = ((square + 0.5 * (square + 1e-4).sqrt()) * known).sum() / known.sum().clamp(min=1)
        loss.backward()
        self.update(progress)
        self.samples += len(tiles)
        return {"loss": float(loss.detach())}

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def validate(self, out: Path) -> dict[str, float]:
        """RMS error of the estimated relief, and of zero relief, `rms_of_none`, on held-out pictures."""
        squares = []
        for file in self.files[: self.held_out]:
            picture = load_example(file)
            height, width = (side - side % fine.SIZE_MULTIPLE for side in picture.shape[1:])
            relief, target, known = _predict(self.average, picture[None, :, :height, :width])
            squares.append([float((((r - target) * known) ** 2).sum() / known.sum()) for r in (relief, 0 * relief)])
        rms, rms_of_none = np.sqrt(np.mean(squares, axis=0))
        return {"rms": float(rms), "rms_of_none": float(rms_of_none)}


@cache
def load_example(file: Path) -> NDArray[np.float16]:
    """Read a training picture of the refinement network: input channels (N), target relief (3), its mask (1)."""
    picture = np.load(file)
    channels = picture[:_INPUTS].astype(np.float32)
    truth, known = picture[_INPUTS : _INPUTS + 3].astype(np.float32), picture[-1] > 0
    shrink = float(np.exp(channels[-1].max()))  # from the channel `log_shrink`, constant in the mask
    relief = fine.high_pass(np.moveaxis(truth - channels[_NORMAL : _NORMAL + 3], 0, -1), known, shrink)
    return np.concatenate([picture[:_INPUTS], np.moveaxis(relief, -1, 0), known[None]]).astype(np.float16)


def cut_tile(picture: NDArray[np.float16], rng: np.random.Generator) -> Floats:
    """Cut a training tile (C, 96, 96) about a random object pixel, rotated and mirrored at random."""
    inside = np.flatnonzero(picture[-1])
    y, x = divmod(int(inside[rng.integers(len(inside))]), picture.shape[2])
    half = _TILE // 2
    top, left = max(0, half - y), max(0, half - x)
    part = picture[:, max(0, y - half) : y + half, max(0, x - half) : x + half]
    tile = np.zeros((len(picture), _TILE, _TILE), np.float32)
    tile[:, top : top + part.shape[1], left : left + part.shape[2]] = part
    return rotate(tile, int(rng.integers(4)), bool(rng.integers(2)))


def rotate(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """Mirror a training picture (C, H, W) left to right, then rotate it counter-clockwise by quarter turns.

    Pixels (C, H, W) move, and so do the vectors and doubled angles in the channels.
    """
    out = np.array(np.rot90(picture[..., ::-1] if mirror else picture, quarters, axes=(1, 2)))
    for first in _DOUBLE_ANGLES:  # a quarter turn negates both channels, a mirror the second
        out[first : first + 2] *= (-1.0) ** quarters
        out[first + 1] *= -1.0 if mirror else 1.0
    for first in (*_VECTORS, _INPUTS):
        x, y = (-out[first] if mirror else out[first].copy()), out[first + 1].copy()
        for _ in range(quarters):
            x, y = -y, x
        out[first], out[first + 1] = x, y
    return out


def _predict(network: nn.Module, pictures: Floats) -> tuple[Tensor, Tensor, Tensor]:
    """Run the refinement network on pictures (B, N + 4, H, W): estimated and target relief, mask of known relief."""
    batch = torch.from_numpy(pictures.astype(np.float32))
    channels = batch[:, :_INPUTS].contiguous(memory_format=torch.channels_last)
    return network(channels), batch[:, _INPUTS : _INPUTS + 3], batch[:, _INPUTS + 3 :]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), *sys.argv[5:6])
