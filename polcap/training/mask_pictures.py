"""Picture files of the mask's training: each is made once, by its number, and read with random light and noise.

::

    FOLDER/000017.npy   (H, W, 7) fp16: S0 in linear Rec.709, S1 and S2 summed over colors, object, chart
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

SIZE = (288, 384)  # H, W, traced; files have half of it
_VIEWS, _SCENES = 3, 2  # views of each mesh, scenes of each view
_MISSED = 0.15  # share of charts that are in the picture but not found


def make_pictures(out: Path, data: Path, count: int, seed: int = 5) -> None:
    """Make those of pictures 0…count − 1 that the folder lacks, from the training meshes and materials."""
    torch.set_num_threads(1)
    files = traced_views.training_meshes(data)
    library = materials.MaterialLibrary(data / "materials" / "train", torch.device("cpu"))
    out.mkdir(parents=True, exist_ok=True)
    for group in range(-(-count // (_VIEWS * _SCENES))):
        first = group * _VIEWS * _SCENES
        if all((out / f"{n:06d}.npy").exists() for n in range(first, first + _VIEWS * _SCENES)):
            continue
        for number, picture in enumerate(_make_group(files, library, seed, group), start=first):
            with atomic.path(out / f"{number:06d}.npy") as temporary, temporary.open("wb") as file:
                np.save(file, picture)


def _make_group(files: list[Path], library: materials.MaterialLibrary, seed: int, group: int) -> Iterator[Floats]:
    """The pictures of one mesh."""
    rng = np.random.default_rng([seed, group])
    torch.manual_seed(int(rng.integers(1 << 62)))
    tracer = Tracer(_mesh(files, rng))
    made = 0
    while made < _VIEWS:
        view = mask_views.trace_view(tracer, mask_views.draw_kind(rng), SIZE, rng)
        if view is None:
            continue
        made += 1
        for _ in range(_SCENES):
            mode = rng.choice(list(mask_scenes.MODES), p=list(mask_scenes.MODES.values()))
            yield pack(mask_scenes.make_scene(view, library, mode, rng))


def _mesh(files: list[Path], rng: np.random.Generator) -> Triangles:
    """One random object, or two or three side by side."""
    if rng.random() < 0.75:
        return _one(files, rng)
    return mask_views.side_by_side([_one(files, rng) for _ in range(rng.integers(2, 4))], rng)


def _one(files: list[Path], rng: np.random.Generator) -> Triangles:
    """A scanned mesh, or a random shape, with branches or without."""
    kind = rng.random()
    if kind < 0.4:
        return centred(traced_views.read_mesh(files[rng.integers(len(files))]))
    return random_shapes.compose(rng) if kind < 0.7 else random_shapes.compose_with_branches(rng)


def pack(picture: mask_scenes.MaskScene) -> Floats:
    """Layers (H/2, W/2, 7) of a file: means of 2 × 2 pixels; radiance in units of its 95th percentile."""
    stokes = picture.stokes / max(float(np.percentile(picture.stokes[0].mean(-1), 95)), 1e-9)
    sums = np.moveaxis(stokes[1:].sum(-1), 0, -1)
    parts = [stokes[0], sums, picture.mask[..., None], picture.chart[..., None]]
    whole = np.clip(np.concatenate(parts, axis=-1), -6e4, 6e4)
    height, width, count = whole.shape
    return np.asarray(whole.reshape(height // 2, 2, width // 2, 2, count).mean((1, 3)), np.float16)


def load_varied(file: Path, rng: np.random.Generator, other: Path | None = None) -> tuple[ReducedPicture, Floats]:
    """Read a picture with random light, crop, mirroring and noise; returns it and its truth (H, W).

    other: file of another picture; its object is inserted into this one.
    """
    layers = np.load(file).astype(np.float32)
    if other is not None:
        more = np.load(other).astype(np.float32)
        more[..., 6] = 0
        cover = more[..., 5:6] > 0.5
        layers = np.where(cover & (layers[..., 6:] < 0.5), more, layers)
    layers = _window(layers, rng)
    stokes, mask, chart = layers[..., :5], layers[..., 5], layers[..., 6] > 0.5
    if not chart.any() and rng.random() < 0.3:
        stokes = stokes[..., [*rng.permutation(3), 3, 4]]
    if rng.random() < 0.5:
        stokes, mask, chart = stokes[:, ::-1] * [1, 1, 1, 1, -1], mask[:, ::-1], chart[:, ::-1]
    if rng.random() < 0.1:  # camera upside down
        stokes, mask, chart = stokes[::-1] * [1, 1, 1, 1, -1], mask[::-1], chart[::-1]
    light = np.exp(rng.normal(0, 0.25)) * mask + np.exp(rng.normal(0, 0.25)) * (1 - mask)
    light = light * (1 - chart) + chart
    tint = np.exp(rng.normal(0, 0.1, (2, 3)))
    color = stokes[..., :3] * light[..., None] * np.where((mask > 0)[..., None], tint[0], tint[1])
    sums = np.stack([color.sum(-1), *(np.moveaxis(stokes[..., 3:], -1, 0) * light * rng.uniform(0.6, 1.1))])
    if rng.random() < _MISSED:
        chart = np.zeros_like(chart)
    return mask_scenes.simulate_measurement(color, sums, chart, rng), mask


def _window(layers: Floats, rng: np.random.Generator) -> Floats:
    """The picture (H, W, 7), or in half of the cases a part with enough of the object, enlarged to the same size."""
    height, width = layers.shape[:2]
    for _ in range(4 if rng.random() < 0.5 else 0):
        share = rng.uniform(0.6, 0.95)
        tall, wide = int(height * share), int(width * share)
        y, x = rng.integers(height - tall + 1), rng.integers(width - wide + 1)
        part = layers[y : y + tall, x : x + wide]
        if 0.01 < part[..., 5].mean() < 0.9:
            return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR))
    return layers
