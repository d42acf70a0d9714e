"""Training of the main network, `polcap train`: traced views, simulated pictures, training loop, exported model.

With a budget of pictures, an uninterrupted run gives the same weights for the same seed on the same machine.
"""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polcap.errors import InputError
from polcap.formats import own_files
from polcap.formats.maps import png
from polcap.training import loop, loss, main_network, materials, onnx_export, traced_views
from polcap.training.progress import Report, silent
from polcap.training.scores import mean_score
from polcap.training.simulator import Batch, Simulator
from polcap.training.validation import HeldOutPictures
from polcap.training.variants import VARIANTS

_FILES = ("last.pt", "model.onnx", "metrics.csv", "watch.csv", "watch.png", "views", "watch")
_AHEAD = 4  # batches that wait for the network


@dataclass(frozen=True)
class TrainingOptions:
    """One training run; a field for each option of `polcap train`."""

    preset: str = "cpu"  # cpu | gpu: size of the network, of the views and of a batch
    data: Path = Path("data")  # holds meshes/ and materials/
    out: Path = Path("runs/train")  # traced views, checkpoints, metrics
    minutes: float = 90.0  # training time, resumed parts included; tracing is extra
    samples: int | None = None  # budget in pictures, instead of minutes
    resume: bool = False  # continue from out/last.pt
    start: Path | None = None  # ONNX model with the first weights; else random ones
    done: int = 0  # pictures of `samples` with which `start` was trained; the schedule continues from there
    views: int | None = None  # of each mesh, instead of the preset's
    procedural: int | None = None  # random shapes, instead of the preset's
    flat: int | None = None  # flat and sharp-edged shapes, instead of the preset's
    threads: int = 2  # on a CPU, each with a batch of its own; one more thread makes the batches
    seed: int = 1
    rate: float = 1e-3  # of Muon; at twice this rate weights grew until training diverged
    variant: str = "ours"  # key of VARIANTS
    licence: str = onnx_export.UNSTATED  # SPDX name, of the trained weights
    traced: Path | None = None  # holds the traced views, instead of `out`


@dataclass(frozen=True)
class TrainingPreset:
    """Size of the network, of its traced training views and of a batch."""

    shape: main_network.NetworkShape
    views: int  # per training mesh
    procedural: int  # random shapes, 6 views each
    flat: int  # flat and sharp-edged shapes, 6 views each
    size: int  # of traced views, px
    sizes: tuple[int, ...]  # of the pictures of a batch, px
    early: tuple[float, ...]  # probabilities of the sizes in the first half of the budget: many objects
    late: tuple[float, ...]  # in the second half: detail
    pixels: int  # of a batch


PRESETS = {
    "cpu": TrainingPreset(
        main_network.SMALL, views=80, procedural=1200, flat=600, size=192, sizes=(96, 128, 160, 192),
        early=(0.4, 0.35, 0.15, 0.1), late=(0.1, 0.25, 0.3, 0.35), pixels=10 * 128**2,
    ),
    "gpu": TrainingPreset(
        main_network.LARGE, views=400, procedural=3000, flat=1500, size=256, sizes=(128, 192, 256),
        early=(0.5, 0.3, 0.2), late=(0.1, 0.4, 0.5), pixels=64 * 256**2,
    ),
}  # fmt: skip


def main(options: TrainingOptions, report: Report = silent) -> Path:
    """Train and return the path of model.onnx; its folder also gets last.pt, metrics.csv, watch.csv and watch.png.

    Raises InputError: an option is unknown, or contradicts another one or the content of `out`; or there are no test
    meshes. StorageError: it is a new run, and `out` holds such a file that polcap did not write.
    """
    _check(options)
    with own_files.opened(options.out) if options.resume else own_files.claimed(options.out, _FILES):
        return _train(options, report)


def _train(options: TrainingOptions, report: Report) -> Path:
    """The training of `main`, once its folder is claimed."""
    preset = PRESETS[options.preset]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    learners = options.threads if device.type == "cpu" else 1
    torch.manual_seed(options.seed)
    network = NetworkTraining(preset.shape, device, options.rate, learners, options.variant)
    if options.resume:
        network.load(options.out / "last.pt")
    elif options.start:
        network.begin(options.start, options.done)
    views = preset.views if options.views is None else options.views
    procedural = preset.procedural if options.procedural is None else options.procedural
    flat = preset.flat if options.flat is None else options.flat
    recipe = traced_views.ViewsRecipe(views=views, procedural=procedural, size=preset.size, seed=13, flat=flat)
    traced = options.traced or options.out
    cache = traced_views.open_cache(traced / "views", traced_views.training_meshes(options.data), recipe, report)
    library = materials.MaterialLibrary(options.data / "materials" / "train", device)
    network.held_out = HeldOutPictures(options.data, traced / "watch", device, report)
    torch.set_num_threads(1)
    budget = loop.Budget(options.minutes, options.samples)
    made = _make_batches(Simulator(cache, library, device), preset, network, budget, options.seed + network.step)
    batches = _run_ahead(made)
    loop.run(network, lambda: [next(batches) for _ in range(learners)], budget, options.out, report)
    batches.close()
    network.export(options.out / "model.onnx", options.out.resolve().name, options.licence)
    return options.out / "model.onnx"


def _check(options: TrainingOptions) -> None:
    """Raise InputError for options that contradict each other, the data or the output folder."""
    if (options.data / "dataset.json").exists():
        raise InputError(
            f"{options.data} is a data set of `polcap synth --dataset`, which holds pictures; `polcap train` renders "
            "its own pictures: give a folder with meshes/ and materials/"
        )
    if not options.licence.strip():
        raise InputError("--license is empty; name the license of the weights, such as CC-BY-4.0, or leave it out")
    for name, value, known in (("preset", options.preset, PRESETS), ("variant", options.variant, VARIANTS)):
        if value not in known:
            raise InputError(f"{name} {value!r} is not one of {', '.join(known)}")
    last = options.out / "last.pt"
    if options.resume and options.start:
        raise InputError(
            f"--resume continues the training of {last}, --start begins a new one with the weights of {options.start}; "
            "give one of them"
        )
    if options.resume and not last.exists():
        raise InputError(f"{last} does not exist, so there is nothing to resume; train without --resume first")
    if last.exists() and not options.resume:
        raise InputError(f"{last} exists already; continue from it with --resume, or choose another --out")
    traced_views.test_meshes(options.data)


def _make_batches(
    simulator: Simulator, preset: TrainingPreset, network: loop.Trainee, budget: loop.Budget, seed: int
) -> Iterator[Batch]:
    """Yield training batches without end. The seed determines them, because only this thread draws random numbers."""
    torch.manual_seed(seed)
    chooser, made = np.random.default_rng(seed), network.samples
    while True:
        early = budget.spent(made, network.elapsed) < 0.5
        size = int(chooser.choice(preset.sizes, p=preset.early if early else preset.late))
        count = max(preset.pixels // size**2, 1)
        made += count
        yield simulator.draw_batch(count, size)


def _run_ahead(batches: Iterator[Batch]) -> Generator[Batch, None, None]:
    """Training batches in their order, made in a thread while the network learns from earlier ones."""
    pool = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,))
    try:
        waiting = deque(pool.submit(next, batches) for _ in range(_AHEAD))
        while True:
            waiting.append(pool.submit(next, batches))
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class NetworkTraining(loop.Trainee):
    """Training of the main network: weights, optimizers and parallel learners.

    Each learner is a thread that computes the gradient of one batch; a step uses their mean. Threads that wait for each
    other once per step use a busy machine better than threads that share each operation.
    """

    hold, warm_up, averaging, burst = 0.2, 100, 0.9998, 200.0
    network: main_network.MainNetwork

    def __init__(
        self, shape: main_network.NetworkShape, device: torch.device, rate: float, learners: int = 1,
        variant: str = "ours",
    ) -> None:  # fmt: skip
        super().__init__(main_network.MainNetwork(shape, variant).to(device, memory_format=torch.channels_last), rate)
        self.device = device
        self.weights = list(self.network.parameters())
        self.lights = [torch.Generator(device).manual_seed(k) for k in range(learners)]  # for the rendering loss
        self.pool = ThreadPoolExecutor(learners, initializer=torch.set_num_threads, initargs=(1,))
        self.begun = ""  # training of the first weights, in words
        self.done = 0  # pictures of that training that count for the budget
        self.held_out: HeldOutPictures | None = None

    def advance(self, batch: list[Batch], progress: float) -> dict[str, float]:
        """One training step on one batch per learner; returns the mean losses."""
        self.network.train()
        gradients, figures = zip(*self.pool.map(self._gradient, batch, self.lights))
        for weight, parts in zip(self.weights, zip(*gradients)):
            weight.grad = sum(parts) / len(parts)
        norm = self.update(progress)
        self.samples += sum(len(one.mask) for one in batch)
        return mean_score(figures) | {"gradient": norm}

    def _gradient(self, batch: Batch, lights: torch.Generator) -> tuple[tuple[Tensor, ...], dict[str, float]]:
        """Gradient of the loss of one batch with respect to the weights, and the parts of that loss."""
        maps = main_network.run(self.network, batch.channels)
        polarized = VARIANTS[self.network.variant].polarized_loss
        value, figures = loss.total(maps, batch, lights, polarized=polarized)
        return torch.autograd.grad(value, self.weights), figures

    def validate(self, out: Path) -> dict[str, float]:
        """Mean errors on test meshes; watch.png shows eight of the pictures."""
        assert self.held_out is not None
        png.write(out / "watch.png", self.held_out.picture(self.average))
        errors: dict[str, float] = self.held_out.errors(self.average)
        return errors

    def facts(self) -> dict[str, Any]:
        """Entries of the checkpoint: shape and variant of the network, and the origin of its first weights."""
        shape, variant = asdict(self.network.shape), self.network.variant
        return {"shape": shape, "variant": variant, "begun": self.begun, "done": self.done}

    def begin(self, path: Path, done: int = 0) -> None:
        """Start training with the weights of an exported model.

        With a budget of pictures, `done` of them count as spent, and the schedule continues from there.

        Raises InputError: the model is that of another network.
        """
        weights, metadata = onnx_export.read_weights(path)
        try:
            for network in (self.network, self.average):
                network.load_state_dict(weights)
        except RuntimeError as error:
            remedy = "give --start one that is, or leave it out"
            raise InputError(f"{path} is not a network of this preset; {remedy}") from error
        self.begun = metadata.get("training", "unknown")
        self.samples = self.done = done

    def load(self, path: Path) -> None:
        """Continue from a checkpoint. Raises InputError if it belongs to another preset or variant."""
        state = torch.load(path, map_location=self.device, weights_only=True)
        if (state["shape"], state["variant"]) != (asdict(self.network.shape), self.network.variant):
            began = f"{path} was started with another preset or variant ({state['variant']!r})"
            raise InputError(f"{began}; resume it with the same ones")
        self.restore(state)
        self.begun, self.done = state["begun"], state["done"]
        for k, generator in enumerate(self.lights):  # not the same lights again
            generator.manual_seed(1000 * self.step + k)

    def export(self, path: Path, version: str, licence: str) -> None:
        """Write the averaged weights as an ONNX model, with metadata on their training."""
        training = f"{self.samples - self.done} samples in {self.step} steps, {self.elapsed / 60:.0f} minutes"
        training += f", after {self.begun}" if self.begun else ""
        facts = {"version": version, "licence": licence, "variant": self.network.variant, "training": training}
        onnx_export.export_main(self.average, path, facts)


def load_average(path: Path) -> tuple[main_network.MainNetwork, dict[str, Any]]:
    """Network with the averaged weights of a checkpoint, on the CPU, and the whole checkpoint."""
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    network = main_network.MainNetwork(main_network.NetworkShape(**state["shape"]), state["variant"])
    network.load_state_dict(state["average"])
    return network.eval(), state
