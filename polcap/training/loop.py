"""The training loop of all networks: optimizers, learning rate, averaged weights, checkpoints and metrics.

A budget is a time, so that a run ends when planned on any machine, or a number of pictures, so that runs can be
compared. A stopped run continues from its last checkpoint with the rest of its budget.
"""

import copy
import csv
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from polcap.errors import InputError
from polcap.formats import atomic
from polcap.training import onnx_export
from polcap.training.muon import Muon
from polcap.training.progress import Report, silent
from polcap.training.scores import mean_score

_OUTER_LAYERS = ("stem", "raw", "out", "hint.0")  # next to the pixels: AdamW trains them, Muon all others
_OUTER_RATE = 0.5  # AdamW's rate relative to Muon's
_MAX_GRADIENT_NORM = 1.0  # longer gradients are scaled down to it
_METRICS_STEPS, _FIRST_METRICS = 50, 10  # steps between two rows of metrics.csv; step of an early row
_VALIDATION_S, _CHECKPOINT_S = 600, 60  # s between two validations, two checkpoints
_REPORT_S = 10  # s of training between two lines of progress


@dataclass(frozen=True)
class Budget:
    """Length of a run: a number of pictures if `samples` is set, otherwise minutes."""

    minutes: float
    samples: int | None = None

    def spent(self, samples: int, elapsed: float) -> float:
        """Share 0…1 of the training budget spent after `samples` pictures and `elapsed` seconds."""
        return samples / self.samples if self.samples else elapsed / (60 * self.minutes)


class Trainee(ABC):
    """A network in training: weights, averaged weights, optimizers and progress."""

    hold: float  # share of the budget at the full learning rate, which then falls linearly to 0
    warm_up: int  # steps over which the rate rises
    averaging: float  # decay of the averaged weights per step
    burst = math.inf  # steps with a longer gradient are skipped

    def __init__(self, network: nn.Module, rate: float) -> None:
        self.network = network
        self.average = copy.deepcopy(network).eval().requires_grad_(False)  # the network with averaged weights
        self.optimizers = make_optimizers(network, rate)
        self.step, self.samples, self.elapsed = 0, 0, 0.0

    @abstractmethod
    def advance(self, batch: Any, progress: float) -> dict[str, float]:
        """One training step on a batch; returns its losses. `progress` is the spent share of the budget, 0…1."""

    @abstractmethod
    def validate(self, out: Path) -> dict[str, float]:
        """Errors of the averaged weights on held-out pictures; may also write example pictures to `out`."""

    def facts(self) -> dict[str, Any]:
        """Further entries that a subclass adds to the checkpoint file."""
        return {}

    def update(self, progress: float) -> float:
        """Apply the gradients, update the averaged weights and return the gradient's norm."""
        decline = min(1.0, (1 - min(progress, 1.0)) / (1 - self.hold))
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM, foreach=True))
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["full"] * decline * min(1.0, (self.step + 1) / self.warm_up)
            if norm < self.burst:
                optimizer.step()
            optimizer.zero_grad()
        self.step += 1
        decay = min(self.averaging, (1 + self.step) / (10 + self.step))  # smaller in the first steps
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1 - decay)
        return norm

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        state = {
            "network": self.network.state_dict(), "average": self.average.state_dict(), "step": self.step,
            "samples": self.samples, "elapsed": self.elapsed,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }  # fmt: skip
        with atomic.path(path) as temporary:
            torch.save(state | self.facts(), temporary)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Set weights, optimizers and progress from the content of a checkpoint."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"]):
            optimizer.load_state_dict(saved)
        self.step, self.samples, self.elapsed = state["step"], state["samples"], state["elapsed"]


class PictureTraining(Trainee):
    """Training of a small network on picture files, of which the first are held out for validation."""

    held_out: int  # pictures
    per_step: int  # pictures
    output: str  # name of the network's map
    metadata: ClassVar[Mapping[str, str]]  # of the exported model

    def __init__(self, network: nn.Module, rate: float, files: list[Path]) -> None:
        super().__init__(network.to(memory_format=torch.channels_last), rate)
        self.files = files
        self.random = np.random.default_rng([1, 0])

    def train(self, minutes: float, out: Path) -> None:
        """Train for `minutes` in all, from out/last.pt if it exists; the time of that earlier training counts.

        Raises InputError: there are too few pictures to hold some out.
        """
        if len(self.files) <= self.held_out:
            raise InputError(f"{len(self.files)} pictures; training needs more than the {self.held_out} held out")
        if (out / "last.pt").exists():
            self.restore(torch.load(out / "last.pt", weights_only=True))
        self.random = np.random.default_rng([1, self.step])
        run(self, self.draw, Budget(minutes), out)

    def draw(self) -> list[Path]:
        """Draw the picture files of a training step."""
        return [self.files[n] for n in self.random.integers(self.held_out, len(self.files), self.per_step)]

    def export(self, path: Path, licence: str) -> None:
        """Write the averaged weights as an ONNX model that `formats/onnx.py` loads; `licence` is its SPDX name."""
        training = f"{self.samples} samples in {self.step} steps"
        metadata = {"licence": licence, "training": training, **self.metadata}
        onnx_export.export_network(self.average, path, (self.output,), metadata)


def run(trainee: Trainee, draw: Callable[[], Any], budget: Budget, out: Path, report: Report = silent) -> None:
    """Train a network until the budget is spent. Writes last.pt, metrics.csv and watch.csv to `out`."""
    saved = validated = trainee.elapsed
    reported = -math.inf
    before, losses = time.monotonic(), []
    progress = budget.spent(trainee.samples, trainee.elapsed)
    while progress < 1:
        losses.append(trainee.advance(draw(), progress))
        now = time.monotonic()
        trainee.elapsed, before = trainee.elapsed + now - before, now
        progress = budget.spent(trainee.samples, trainee.elapsed)
        if trainee.elapsed - reported > _REPORT_S or progress >= 1:
            reported = trainee.elapsed
            left = trainee.elapsed * (1 / progress - 1) / 60
            done = f"{100 * min(progress, 1):.0f} %, step {trainee.step}, {trainee.samples} pictures"
            report(f"{done}, loss {losses[-1].get('loss', math.nan):.3g}, {max(left, 0):.0f} min left")
        if trainee.step % _METRICS_STEPS == 0 or trainee.step == _FIRST_METRICS or progress >= 1:
            _append(out / "metrics.csv", trainee, mean_score(losses))
            losses = []
        if trainee.elapsed - validated > _VALIDATION_S or progress >= 1:
            validated = trainee.elapsed
            _append(out / "watch.csv", trainee, trainee.validate(out))
            before = time.monotonic()  # validation does not count as training time
        if trainee.elapsed - saved > _CHECKPOINT_S:
            saved = trainee.elapsed
            trainee.save(out / "last.pt")
    trainee.save(out / "last.pt")


def make_optimizers(network: nn.Module, rate: float) -> list[torch.optim.Optimizer]:
    """The optimizers of a network: Muon for hidden layers; AdamW for outer layers, biases and curves (`knots`)."""
    named = list(network.named_parameters())
    plain = [weight for name, weight in named if weight.ndim <= 1 or "knots" in name]
    matrices = [(name, weight) for name, weight in named if weight.ndim > 1 and "knots" not in name]
    outer = [weight for name, weight in matrices if any(part in name for part in _OUTER_LAYERS)]
    hidden = [weight for name, weight in matrices if not any(part in name for part in _OUTER_LAYERS)]
    others = [{"params": outer, "weight_decay": 1e-2}, {"params": plain, "weight_decay": 0.0}]
    adamw = torch.optim.AdamW(others, _OUTER_RATE * rate, betas=(0.9, 0.98), fused=True)
    optimizers: list[torch.optim.Optimizer] = [Muon(hidden, rate), adamw]
    for group in (group for optimizer in optimizers for group in optimizer.param_groups):
        group["full"] = group["lr"]  # before warm-up and decay
    return optimizers


def _append(path: Path, trainee: Trainee, figures: Mapping[str, float]) -> None:
    """Append training progress and figures as one row to a CSV file."""
    row = {"step": trainee.step, "samples": trainee.samples, "seconds": round(trainee.elapsed, 1), **figures}
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(row)
        writer.writerow(f"{value:.7g}" for value in row.values())
