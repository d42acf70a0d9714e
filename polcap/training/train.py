"""Train the network with one command: cache of views, loop, checkpoints, metrics.

The budget is a length of time, so that a run ends when it is meant to on any machine, or a number of
pictures, so that runs can be compared. The learning rate holds for 20 % of it and falls to nothing over the
rest. A run that was stopped goes on from its last checkpoint with what was left. With a budget of pictures
the weights of a run in one piece follow, on one machine, from the seed.
"""

import csv
import ctypes
import queue
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polcap.errors import InputError
from polcap.formats import atomic
from polcap.formats.maps import png
from polcap.training import arithmetic, export, gbuffers, loss, materials, model
from polcap.training.dataset import Batch, Simulator
from polcap.training.variants import VARIANTS
from polcap.training.watch import Watch

_HOLD = 0.2  # share of the budget at the full learning rate
_WARM = 100  # steps
_BURST = 200.0  # norm of a gradient that is not followed
_OUTER_RATE = 0.5  # AdamW's rate by Muon's


@dataclass(frozen=True)
class Params:
    """What one training run is told."""

    preset: str = "cpu"  # cpu | gpu: size of the network, of the views and of a batch
    data: Path = Path("data")  # holds meshes/ and materials/
    out: Path = Path("runs/train")  # cache of views, checkpoints, metrics
    minutes: float = 90.0  # training time, all resumed parts together; building the cache is extra
    samples: int | None = None  # the budget in pictures instead, where runs are to be compared
    piece: float | None = None  # minutes after which this run stops and leaves last.pt, for `resume` to go on from
    resume: bool = False  # go on from out/last.pt
    start: Path | None = None  # ONNX model whose weights are the first; else random ones
    done: int = 0  # pictures of `samples` that the weights of `start` have seen; the schedule goes on from there
    views: int | None = None  # of each mesh, instead of the preset's
    procedural: int | None = None  # random shapes, instead of the preset's
    threads: int = 2  # learners on a CPU, each with a batch of its own; one more thread makes the batches
    seed: int = 1
    rate: float = 1e-3  # of Muon; at twice that, weights without norms grew until training burst
    variant: str = "ours"  # of variants.py


@dataclass(frozen=True)
class Preset:
    shape: model.Shape
    views: int  # per training mesh
    procedural: int  # random shapes, 6 views each
    size: int  # of cached views, px
    sizes: tuple[int, ...]  # that a batch may have, drawn with the weights below
    early: tuple[float, ...]  # in the first half of the budget: many objects
    late: tuple[float, ...]  # in the second: detail
    pixels: int  # of a batch


PRESETS = {
    "cpu": Preset(
        model.SMALL, 80, 1200, 192, (96, 128, 160, 192), (0.4, 0.35, 0.15, 0.1), (0.1, 0.25, 0.3, 0.35), 10 * 128**2
    ),
    "gpu": Preset(model.LARGE, 400, 3000, 256, (128, 192, 256), (0.5, 0.3, 0.2), (0.1, 0.4, 0.5), 64 * 256**2),
}


def main(params: Params) -> Path:
    """Train; leaves last.pt (all that resuming needs), metrics.csv, watch.csv, watch.png, and model.onnx at the end.

    Returns model.onnx, or last.pt where a piece ended before the budget.
    """
    for name, value, known in (("preset", params.preset, PRESETS), ("variant", params.variant, VARIANTS)):
        if value not in known:
            raise InputError(f"{name} {value!r} is not one of {', '.join(known)}")
    if params.resume and params.start:
        raise InputError(f"resume goes on from {params.out / 'last.pt'}, start begins with {params.start}; take one")
    last, looked_at = params.out / "last.pt", params.data / "meshes" / "test"
    if last.exists() and not params.resume:
        raise InputError(f"{last} is there already; go on from it with --resume, or choose another --out")
    if not any(looked_at.glob("*.npz")):
        raise InputError(f"{looked_at} holds no mesh; training looks at some as it goes, put one there")
    preset = PRESETS[params.preset]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    params.out.mkdir(parents=True, exist_ok=True)
    learners = params.threads if device.type == "cpu" else 1
    torch.manual_seed(params.seed)
    run = Run(preset.shape, device, params.rate, learners, params.variant)
    if params.resume:
        run.load(last)
    elif params.start:
        run.begin(params.start, params.done)
    simulator = Simulator(views(params, preset), library(params, "train", device), device)
    watch = Watch(params.data, params.out / "watch", device)
    _keep_memory()
    torch.set_num_threads(1)

    def progress(samples: int) -> float:
        """Share of the budget that is spent with that many pictures made, or learned from."""
        return samples / params.samples if params.samples else run.elapsed / (params.minutes * 60)

    ready = _ahead(simulator, preset, params.seed + run.step, run.samples, progress)
    saved = looked = run.elapsed
    parts: list[dict[str, float]] = []
    before = begun = time.monotonic()
    while progress(run.samples) < 1 and (params.piece is None or before == begun or before - begun < 60 * params.piece):
        parts.append(run.advance([next(ready) for _ in range(learners)], progress(run.samples)))
        now = time.monotonic()
        run.elapsed, before = run.elapsed + now - before, now
        if run.step % 50 == 0 or run.step == 10 or progress(run.samples) >= 1:
            _record(params.out / "metrics.csv", run, {k: float(np.mean([p[k] for p in parts])) for k in parts[0]})
            parts = []
        if run.elapsed - looked > 240 or progress(run.samples) >= 1:
            looked = run.elapsed
            with run.averaged() as network:
                _record(params.out / "watch.csv", run, watch.look(network))
                png.write(params.out / "watch.png", watch.picture(network))
            before = time.monotonic()
        if run.elapsed - saved > 60:
            saved = run.elapsed
            run.save(last)
    ready.close()
    run.save(last)
    if progress(run.samples) < 1:
        return last
    ship(last, params.out / "model.onnx", version=params.out.resolve().name)
    return params.out / "model.onnx"


def _keep_memory() -> None:
    """Tell glibc to keep what is freed: fetching the same pages anew at each step costs more than the arithmetic."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:  # numbers from malloc.h
        for option, value in ((-8, 1), (-4, 0), (-1, 2**31 - 1), (-2, 2**28)):  # arenas, mmaps, trim, top pad
            mallopt(option, value)


def views(params: Params, preset: Preset) -> dict[str, Any]:
    """The cache of training views, traced now where it is not there yet."""
    meshes = gbuffers.training_meshes(params.data)
    of_mesh, of_chance = (
        n if n is not None else usual
        for n, usual in ((params.views, preset.views), (params.procedural, preset.procedural))
    )
    recipe = gbuffers.Recipe(views=of_mesh, procedural=of_chance, size=preset.size, seed=13)
    return gbuffers.cached(params.out / "views", meshes, recipe)


def library(params: Params, split: str, device: torch.device) -> materials.Library:
    folder = params.data / "materials" / split
    return materials.Library(folder if folder.exists() else None, device)


def _ahead(
    simulator: Simulator, preset: Preset, seed: int, made: int, progress: Callable[[int], float]
) -> Generator[Batch, None, None]:
    """Batches without end, made in a thread of their own while the network learns from those before.

    That thread alone draws from torch's global random state, so the batches follow from the seed and from when
    the sizes change. `made` pictures were made before, `progress` says how far that is.
    """
    waiting: queue.Queue[Batch | BaseException] = queue.Queue(maxsize=4)
    ended = threading.Event()

    def make() -> None:
        nonlocal made
        try:
            torch.set_num_threads(1)
            torch.manual_seed(seed)
            chooser = np.random.default_rng(seed)
            while not ended.is_set():
                size = int(chooser.choice(preset.sizes, p=preset.early if progress(made) < 0.5 else preset.late))
                count = max(preset.pixels // size**2, 1)
                made += count
                waiting.put(simulator.draw(count, size))
        except BaseException as error:  # told to the loop, which raises it
            waiting.put(error)

    maker = threading.Thread(target=make, daemon=True)
    maker.start()
    try:
        while True:
            batch = waiting.get()
            if isinstance(batch, BaseException):
                raise batch
            yield batch
    finally:
        ended.set()
        while maker.is_alive():
            with suppress(queue.Empty):
                waiting.get(timeout=0.1)


class Run:
    """Network, its moving average, optimizer and how far they are.

    Each learner is a thread that works out the gradient of one batch; a step follows their mean. Threads
    that meet once a step waste less of a busy machine than threads that meet in every operation.
    """

    def __init__(
        self, shape: model.Shape, device: torch.device, rate: float, learners: int = 1, variant: str = "ours"
    ) -> None:
        self.device = device
        self.network = model.Network(shape, variant).to(device, memory_format=torch.channels_last)
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimizers = _optimizers(self.network, rate)
        self.weights = list(self.network.parameters())
        self.lights = [torch.Generator(device).manual_seed(k) for k in range(learners)]  # of the rendering loss
        self.pool = ThreadPoolExecutor(learners, initializer=torch.set_num_threads, initargs=(1,))
        self.step, self.samples, self.elapsed, self.skipped = 0, 0, 0.0, 0
        self.begun = ""  # what the first weights had learned from
        self.done = 0  # pictures of the budget among those

    def advance(self, batches: list[Batch], progress: float) -> dict[str, float]:
        """One step on a batch per learner; progress 0…1 of the budget sets the rate."""
        fall = min(1.0, (1 - min(progress, 1.0)) / (1 - _HOLD))
        for group in (g for optimizer in self.optimizers for g in optimizer.param_groups):
            group["lr"] = group["full"] * min(1.0, (self.step + 1) / _WARM) * fall
        self.network.train()
        learned = list(self.pool.map(self._learn, batches, self.lights))
        for weight, gradient in zip(self.weights, learned[0][0]):
            weight.grad = gradient
        for number, (others, _) in enumerate(learned[1:], start=2):  # their mean
            torch._foreach_lerp_([weight.grad for weight in self.weights], list(others), 1 / number)
        norm = torch.nn.utils.clip_grad_norm_(self.weights, 1.0, foreach=True)
        if norm < _BURST:
            for optimizer in self.optimizers:
                optimizer.step()
        else:
            self.skipped += 1
        self.step += 1
        self.samples += sum(len(batch.mask) for batch in batches)
        keep = min(0.999, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            weights = list(self.network.state_dict().values())
            torch._foreach_lerp_(list(self.average.values()), weights, 1 - keep)
        parts = [figures for _, figures in learned]
        return {k: float(np.mean([p[k] for p in parts])) for k in parts[0]} | {"gradient": float(norm)}

    def _learn(self, batch: Batch, lights: torch.Generator) -> tuple[tuple[Tensor, ...], dict[str, float]]:
        """Gradient of the loss of one batch, and its parts."""
        with arithmetic.fast(self.device):
            maps = self.network(batch.channels.contiguous(memory_format=torch.channels_last))
        polarized = VARIANTS[self.network.variant].polarized_loss
        value, figures = loss.total(maps, batch, lights, polarized=polarized)
        return torch.autograd.grad(value, self.weights), figures

    @contextmanager
    def averaged(self) -> Iterator[model.Network]:
        """The network with its EMA weights, for as long as the block lasts."""
        held = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.network.load_state_dict(self.average)
        try:
            yield self.network.eval()
        finally:
            self.network.load_state_dict(held)

    def save(self, path: Path) -> None:
        state = {
            "network": self.network.state_dict(), "average": self.average,
            "optimizers": [o.state_dict() for o in self.optimizers], "shape": asdict(self.network.shape),
            "variant": self.network.variant,
            "step": self.step, "samples": self.samples, "elapsed": self.elapsed, "skipped": self.skipped,
            "begun": self.begun, "done": self.done,
        }  # fmt: skip
        with atomic.path(path) as beside:
            torch.save(state, beside)

    def begin(self, path: Path, done: int = 0) -> None:
        """Take a model's weights as the first, from `export.write`; InputError where they are another network's.

        `done` pictures of the budget count as learned; the schedule goes on from there.
        """
        weights, metadata = export.read(path)
        for name, own in self.network.state_dict().items():
            if name in weights:
                weights[name] = _widened(weights[name], own)
        try:
            self.network.load_state_dict(weights)
        except RuntimeError as error:
            raise InputError(f"{path} is not a network of this preset; start from one that is, or without") from error
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.begun = metadata.get("training", "unknown")
        self.samples = self.done = done

    def load(self, path: Path) -> None:
        if not path.exists():
            raise InputError(f"{path} is not there: nothing to resume; train without resume first")
        state = torch.load(path, map_location=self.device, weights_only=True)
        if (state["shape"], state["variant"]) != (asdict(self.network.shape), self.network.variant):
            raise InputError(f"{path} began with another preset or as {state['variant']!r}; resume it as it began")
        self.network.load_state_dict(state["network"])
        self.average = {k: v.clone() for k, v in state["average"].items()}
        for optimizer, held in zip(self.optimizers, state["optimizers"]):
            optimizer.load_state_dict(held)
        self.step, self.samples, self.elapsed = state["step"], state["samples"], state["elapsed"]
        self.skipped, self.begun, self.done = state["skipped"], state["begun"], state["done"]
        for k, generator in enumerate(self.lights):  # other lights than before
            generator.manual_seed(1000 * self.step + k)


def _widened(weight: Tensor, own: Tensor) -> Tensor:
    """Of a convolution that came to see more channels, the last of which change nothing yet."""
    more = own.shape[1] - weight.shape[1] if own.ndim == weight.ndim == 4 else 0
    if more <= 0 or own.shape[0] != weight.shape[0] or own.shape[2:] != weight.shape[2:]:
        return weight
    return torch.cat([weight, weight.new_zeros(len(weight), more, *weight.shape[2:])], dim=1)


class Muon(torch.optim.Optimizer):  # type: ignore[misc]  # torch comes without types here
    """Momentum whose matrix is made orthogonal before each step, so that no direction of a filter bank is starved.

    For convolutions: (out, in·kh·kw) matrices. Measured here at 1,316 samples from nothing: 15.9° against
    AdamW's 20.2° on training pictures.

    References
    ----------
    Jordan et al., Muon: an optimizer for hidden layers in neural networks, 2024.
    Liu et al., Muon is scalable for LLM training, 2025 (length of the step).
    """

    def __init__(self, weights: list[Tensor], rate: float, momentum: float = 0.95, decay: float = 0.1) -> None:
        super().__init__(weights, {"lr": rate, "momentum": momentum, "decay": decay})

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def step(self) -> None:
        for group in self.param_groups:
            alike: dict[torch.Size, list[tuple[Tensor, Tensor]]] = {}  # weights and where they should go, by shape
            for weight in group["params"]:
                gradient = _matrix(_lying(weight.grad))
                mean = self.state[weight].setdefault("mean", torch.zeros_like(gradient))
                mean.lerp_(gradient, 1 - group["momentum"])
                ahead = gradient.lerp(mean, group["momentum"])  # Nesterov's look ahead
                alike.setdefault(ahead.shape, []).append((_matrix(weight), ahead))
            for shape, pairs in alike.items():
                steps = orthogonal(torch.stack([ahead for _, ahead in pairs]))
                length = 0.2 * max(shape) ** 0.5 * group["lr"]  # of rms 0.2 rate per weight
                for (matrix, _), step in zip(pairs, steps):
                    matrix.mul_(1 - group["lr"] * group["decay"]).add_(step, alpha=-length)


def _matrix(weight: Tensor) -> Tensor:
    """(out, in) of a layer's weights, (out, kh·kw·in) of a convolution's that lie channels last, sharing memory."""
    return weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).view(len(weight), -1)


def _lying(weight: Tensor) -> Tensor:
    """The same values with channels last."""
    return weight if weight.ndim == 2 else weight.contiguous(memory_format=torch.channels_last)


def orthogonal(matrix: Tensor) -> Tensor:
    """About U Vᵀ of matrices' singular value decompositions, (N, rows, columns), by five Newton-Schulz steps.

    Singular values end within 0.7…1.2, not at 1, where fewer steps would be needed.
    """
    wide = matrix if matrix.shape[-2] <= matrix.shape[-1] else matrix.mT
    x = (wide / (torch.linalg.matrix_norm(wide, keepdim=True) + 1e-7)).to(arithmetic.kind(matrix.device))
    for _ in range(5):
        square = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=-4.7750, alpha=2.0315), x, beta=3.4445)
    return (x if matrix.shape[-2] <= matrix.shape[-1] else x.mT).to(matrix.dtype)


def _optimizers(network: model.Network, rate: float) -> list[torch.optim.Optimizer]:
    """Muon for the matrices of convolutions and readers; AdamW for stems, maps' last layers, biases and knots."""
    outer = ("stem", "raw", "out", "hint.0")
    hidden, decay, plain = [], [], []
    for name, weight in network.named_parameters():
        if weight.ndim <= 1 or "knots" in name:
            plain.append(weight)
        elif any(part in name for part in outer):
            decay.append(weight)
        else:
            hidden.append(weight)
    others = [{"params": decay, "weight_decay": 1e-2}, {"params": plain, "weight_decay": 0.0}]
    both = [Muon(hidden, rate), torch.optim.AdamW(others, _OUTER_RATE * rate, betas=(0.9, 0.98), fused=True)]
    for group in (g for optimizer in both for g in optimizer.param_groups):
        group["full"] = group["lr"]  # before warm-up and decay
    return both


def load_average(path: Path) -> tuple[model.Network, dict[str, Any]]:
    """The network with the EMA weights of a checkpoint, on the CPU, and the checkpoint's other facts."""
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    network = model.Network(model.Shape(**state["shape"]), state["variant"])
    average: dict[str, Tensor] = state["average"]
    network.load_state_dict(average)
    return network.eval(), {k: state[k] for k in ("step", "samples", "elapsed", "begun", "done")}


def ship(checkpoint: Path, path: Path, version: str, licence: str = "Apache-2.0") -> int:
    """Export a checkpoint's EMA weights with what is known of their training. Returns the file's bytes."""
    network, facts = load_average(checkpoint)
    metadata = {"version": version, "licence": licence, "variant": network.variant}
    learned = facts["samples"] - facts["done"]
    training = f"{learned} samples in {facts['step']} steps, {facts['elapsed'] / 60:.0f} minutes"
    if facts["begun"]:
        training += f", after {facts['begun']}"
    return export.write(network, path, metadata | {"training": training})


def _record(path: Path, run: Run, figures: dict[str, float]) -> None:
    row = {"step": run.step, "samples": run.samples, "seconds": round(run.elapsed, 1)} | {
        k: f"{v:.5g}" for k, v in figures.items()
    }
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if fresh:
            writer.writeheader()
        writer.writerow(row)
