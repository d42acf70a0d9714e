"""The training loop of every network: optimizers, learning rate, averaged weights, checkpoints and metrics.

A budget is a length of time, so that a run ends on any machine when it should, or a number of pictures, so that runs
can be compared. A stopped run goes on from its last checkpoint with the rest of its budget.
"""

import csv
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from polcap.errors import InputError
from polcap.formats import atomic
from polcap.training.muon import Muon

_OUTER_LAYERS = ("stem", "raw", "out", "hint.0")  # beside the pixels: learned by AdamW, the others by Muon
_OUTER_RATE = 0.5  # AdamW's rate relative to Muon's
_STEEPEST = 1.0  # norm to which gradients are clipped
_METRICS_STEPS = 50
_VALIDATION_S, _CHECKPOINT_S = 240, 60


@dataclass(frozen=True)
class Budget:
    """How long a run lasts: pictures where their number is stated, else minutes."""

    minutes: float
    samples: int | None = None


@dataclass(frozen=True)
class Schedule:
    """Learning rate and averaging over the steps of a run."""

    hold: float  # share of the budget at the full rate; then it falls linearly to nothing
    warm_up: int  # steps over which the rate rises
    averaging: float  # decay of the averaged weights per step
    burst: float = math.inf  # norm of a gradient that is skipped


class Trainee(ABC):
    """A network in training: weights, averaged weights, optimizers and progress."""

    schedule: Schedule

    def __init__(self, network: nn.Module, rate: float) -> None:
        self.network = network
        self.average = {k: v.detach().clone() for k, v in network.state_dict().items()}
        self.optimizers = make_optimizers(network, rate)
        self.step, self.samples, self.elapsed, self.skipped = 0, 0, 0.0, 0

    @abstractmethod
    def advance(self, batch: Any, progress: float) -> dict[str, float]:
        """One step; returns losses. `progress` is the share of the budget that is spent, 0…1."""

    @abstractmethod
    def validate(self, out: Path) -> dict[str, float]:
        """Errors on pictures that the network never learned from; may leave pictures in `out`."""

    def facts(self) -> dict[str, Any]:
        """Further entries of the checkpoint."""
        return {}

    def progress(self, budget: Budget, samples: int | None = None) -> float:
        """Share of the budget that is spent, after so many pictures where their number limits the run."""
        if budget.samples:
            return (self.samples if samples is None else samples) / budget.samples
        return self.elapsed / (60 * budget.minutes)

    def update(self, progress: float) -> float:
        """Step along the gathered gradients and average the weights; returns the gradient's norm."""
        fall = min(1.0, (1 - min(progress, 1.0)) / (1 - self.schedule.hold))
        for group in (g for optimizer in self.optimizers for g in optimizer.param_groups):
            group["lr"] = group["full"] * fall * min(1.0, (self.step + 1) / self.schedule.warm_up)
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), _STEEPEST, foreach=True))
        skip = not norm < self.schedule.burst
        for optimizer in self.optimizers:
            if not skip:
                optimizer.step()
            optimizer.zero_grad()
        self.step, self.skipped = self.step + 1, self.skipped + skip
        decay = min(self.schedule.averaging, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.values()), list(self.network.state_dict().values()), 1 - decay)
        return norm

    @contextmanager
    def averaged(self) -> Iterator[nn.Module]:
        """The network with its averaged weights, inside the block."""
        current = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.network.load_state_dict(self.average)
        try:
            yield self.network.eval()
        finally:
            self.network.load_state_dict(current)
            self.network.train()

    def save(self, path: Path) -> None:
        """Write a checkpoint. Raises StorageError."""
        state = {
            "network": self.network.state_dict(), "average": self.average, "step": self.step, "samples": self.samples,
            "elapsed": self.elapsed, "skipped": self.skipped,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }  # fmt: skip
        with atomic.path(path) as temporary:
            torch.save(state | self.facts(), temporary)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a checkpoint's content."""
        self.network.load_state_dict(state["network"])
        self.average = {k: v.clone() for k, v in state["average"].items()}
        for optimizer, saved in zip(self.optimizers, state["optimizers"]):
            optimizer.load_state_dict(saved)
        self.step, self.samples = state["step"], state["samples"]
        self.elapsed, self.skipped = state["elapsed"], state["skipped"]


class PictureTraining(Trainee):
    """Training of a small network on picture files, some of which are held out for validation."""

    held_out: int
    per_step: int

    def __init__(self, network: nn.Module, rate: float, files: list[Path], seed: int) -> None:
        super().__init__(network.to(memory_format=torch.channels_last), rate)
        self.files, self.seed = files, seed
        self.random = np.random.default_rng([seed, 0])

    def resume(self, checkpoint: Path) -> None:
        """Go on from the checkpoint where there is one.

        Raises
        ------
        InputError
            There are no more pictures than are held out.
        """
        if len(self.files) <= self.held_out:
            raise InputError(f"{len(self.files)} pictures; training needs more than the {self.held_out} held out")
        if checkpoint.exists():
            self.restore(torch.load(checkpoint, weights_only=True))
        self.random = np.random.default_rng([self.seed, self.step])

    def draw(self) -> list[Path]:
        """Pictures of a step."""
        return [self.files[n] for n in self.random.integers(self.held_out, len(self.files), self.per_step)]


def run(trainee: Trainee, draw: Callable[[], Any], budget: Budget, out: Path) -> None:
    """Learn until the budget is spent. Leaves last.pt, metrics.csv and watch.csv in `out`."""
    saved = validated = trainee.elapsed
    before, losses = time.monotonic(), []
    while trainee.progress(budget) < 1:
        losses.append(trainee.advance(draw(), trainee.progress(budget)))
        now = time.monotonic()
        trainee.elapsed, before = trainee.elapsed + now - before, now
        done = trainee.progress(budget) >= 1
        if trainee.step % _METRICS_STEPS == 0 or trainee.step == 10 or done:
            _append(out / "metrics.csv", trainee, {k: float(np.mean([part[k] for part in losses])) for k in losses[0]})
            losses = []
        if trainee.elapsed - validated > _VALIDATION_S or done:
            validated = trainee.elapsed
            _append(out / "watch.csv", trainee, trainee.validate(out))
            before = time.monotonic()  # validation is no training time
        if trainee.elapsed - saved > _CHECKPOINT_S:
            saved = trainee.elapsed
            trainee.save(out / "last.pt")
    trainee.save(out / "last.pt")


def make_optimizers(network: nn.Module, rate: float) -> list[torch.optim.Optimizer]:
    """Muon for hidden matrices; AdamW for layers beside the pixels, biases and knots of curves."""
    hidden: list[Tensor] = []
    outer: list[Tensor] = []
    plain: list[Tensor] = []
    for name, weight in network.named_parameters():
        if weight.ndim <= 1 or "knots" in name:
            plain.append(weight)
        elif any(part in name for part in _OUTER_LAYERS):
            outer.append(weight)
        else:
            hidden.append(weight)
    others = [{"params": outer, "weight_decay": 1e-2}, {"params": plain, "weight_decay": 0.0}]
    both = [Muon(hidden, rate), torch.optim.AdamW(others, _OUTER_RATE * rate, betas=(0.9, 0.98), fused=True)]
    for group in (g for optimizer in both for g in optimizer.param_groups):
        group["full"] = group["lr"]  # before warm-up and decay
    return both


def _append(path: Path, trainee: Trainee, figures: Mapping[str, float]) -> None:
    """Add a row of figures to a CSV file."""
    numbers = {"step": trainee.step, "samples": trainee.samples, "seconds": round(trainee.elapsed, 1), **figures}
    row = {name: f"{value:.7g}" for name, value in numbers.items()}
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if fresh:
            writer.writeheader()
        writer.writerow(row)
