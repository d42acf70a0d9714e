"""A folder of pictures to find the object in: made once, each by its number, then drawn from with new light and noise.

::

    FOLDER/000017.npy   (H, W, 7) fp16: S0 in linear Rec.709, S1 and S2 summed over colours, object, chart
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from polcap.formats import atomic
from polcap.images import Floats
from polcap.stages.mask.mask_channels import ReducedPicture
from polcap.synth.mesh_tracer import Tracer, Triangles, centred
from polcap.training import mask_scenes, mask_views, materials, random_shapes, traced_views

SIZE = (288, 384)  # H, W, traced; half of it is kept
_VIEWS, _DRESSES = 3, 2  # of each mesh, of each view
_UNSEEN = 0.15  # of the charts are in the picture but not found


def make_pictures(out: Path, data: Path, count: int, seed: int = 5) -> None:
    """Make what is missing of pictures 0…count − 1 from the training meshes and materials."""
    torch.set_num_threads(1)
    files = traced_views.training_meshes(data)
    library = materials.MaterialLibrary(data / "materials" / "train", torch.device("cpu"))
    out.mkdir(parents=True, exist_ok=True)
    for group in range(-(-count // (_VIEWS * _DRESSES))):
        first = group * _VIEWS * _DRESSES
        if all((out / f"{n:06d}.npy").exists() for n in range(first, first + _VIEWS * _DRESSES)):
            continue
        for number, picture in enumerate(_make_group(files, library, seed, group), start=first):
            with atomic.path(out / f"{number:06d}.npy") as beside, beside.open("wb") as file:
                np.save(file, picture)


def _make_group(files: list[Path], library: materials.MaterialLibrary, seed: int, group: int) -> Iterator[Floats]:
    """The pictures of one mesh."""
    rng = np.random.default_rng([seed, group])
    torch.manual_seed(int(rng.integers(1 << 62)))
    tracer = Tracer(_mesh(files, rng))
    made = 0
    while made < _VIEWS:
        traced = mask_views.trace_view(tracer, mask_views.draw_kind(rng), SIZE, rng)
        if traced is None:
            continue
        made += 1
        for _ in range(_DRESSES):
            mode = rng.choice(list(mask_scenes.MODES), p=list(mask_scenes.MODES.values()))
            yield pack(mask_scenes.make_scene(traced, library, mode, rng))


def _mesh(files: list[Path], rng: np.random.Generator) -> Triangles:
    """A scan, a random shape, one with limbs, or two or three of them apart."""
    if rng.random() < 0.75:
        return _one(files, rng)
    return mask_views.side_by_side([_one(files, rng) for _ in range(rng.integers(2, 4))], rng)


def _one(files: list[Path], rng: np.random.Generator) -> Triangles:
    kind = rng.random()
    if kind < 0.4:
        return centred(traced_views.read_mesh(files[rng.integers(len(files))]))
    return random_shapes.compose(rng) if kind < 0.7 else random_shapes.compose_with_branches(rng)


def pack(picture: mask_scenes.MaskScene) -> Floats:
    """What a file holds, means of 2 × 2 pixels; radiance in units of its own 95th percentile."""
    stokes = picture.stokes / max(float(np.percentile(picture.stokes[0].mean(-1), 95)), 1e-9)
    sums = np.moveaxis(stokes[1:].sum(-1), 0, -1)
    layers = [stokes[0], sums, picture.mask[..., None], picture.chart[..., None]]
    whole = np.clip(np.concatenate(layers, axis=-1), -6e4, 6e4)
    height, width, count = whole.shape
    return np.asarray(whole.reshape(height // 2, 2, width // 2, 2, count).mean((1, 3)), np.float16)


def load_varied(file: Path, rng: np.random.Generator, other: Path | None = None) -> tuple[ReducedPicture, Floats]:
    """A picture under new light, a part of it, turned or mirrored, and measured; and its truth (H, W).

    other: a picture whose object is laid into this one, too.
    """
    held = np.load(file).astype(np.float32)
    if other is not None:
        more = np.load(other).astype(np.float32)
        more[..., 6] = 0
        cover = more[..., 5:6] > 0.5
        held = np.where(cover & (held[..., 6:] < 0.5), more, held)
    held = _window(held, rng)
    stokes, mask, chart = held[..., :5], held[..., 5], held[..., 6] > 0.5
    if not chart.any() and rng.random() < 0.3:
        stokes = stokes[..., [*rng.permutation(3), 3, 4]]
    if rng.random() < 0.5:
        stokes, mask, chart = stokes[:, ::-1] * [1, 1, 1, 1, -1], mask[:, ::-1], chart[:, ::-1]
    if rng.random() < 0.1:  # the camera stood on its head
        stokes, mask, chart = stokes[::-1] * [1, 1, 1, 1, -1], mask[::-1], chart[::-1]
    light = np.exp(rng.normal(0, 0.25)) * mask + np.exp(rng.normal(0, 0.25)) * (1 - mask)
    light = light * (1 - chart) + chart
    tint = np.exp(rng.normal(0, 0.1, (2, 3)))
    color = stokes[..., :3] * light[..., None] * np.where((mask > 0)[..., None], tint[0], tint[1])
    sums = np.stack([color.sum(-1), *(np.moveaxis(stokes[..., 3:], -1, 0) * light * rng.uniform(0.6, 1.1))])
    if rng.random() < _UNSEEN:
        chart = np.zeros_like(chart)
    return mask_scenes.simulate_measurement(color, sums, chart, rng), mask


def _window(held: Floats, rng: np.random.Generator) -> Floats:
    """Half of the time a part of the picture (H, W, 7) that shows enough of the object, at the picture's size."""
    height, width = held.shape[:2]
    for _ in range(4 if rng.random() < 0.5 else 0):
        share = rng.uniform(0.6, 0.95)
        tall, wide = int(height * share), int(width * share)
        y, x = rng.integers(height - tall + 1), rng.integers(width - wide + 1)
        part = held[y : y + tall, x : x + wide]
        if 0.01 < part[..., 5].mean() < 0.9:
            return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR))
    return held
