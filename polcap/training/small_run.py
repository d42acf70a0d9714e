"""Training of the two small networks, mask and fine pass: weights, their moving average, optimizers, checkpoints."""

import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from polcap.errors import InputError
from polcap.formats import atomic
from polcap.training.train import Muon

_HOLD = 0.35  # share of the budget at the full learning rate
_OUTER = ("stem", "raw", "out")  # layers beside pixels, whose weights AdamW learns, as it does all biases
_STEEPEST = 1.0  # norm of a step's gradient


class SmallRun(ABC):
    """Network, moving average of its weights, optimizers; `rate` is Muon's, half of it AdamW's."""

    made: type[nn.Module]  # the network that learns
    warm: int  # steps over which the rate rises
    keep: float  # share of the average that a step leaves, in the end

    def __init__(self, rate: float) -> None:
        self.network = self.made().to(memory_format=torch.channels_last)
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        hidden: list[Tensor] = []
        others: list[Tensor] = []
        for name, weight in self.network.named_parameters():
            outer = weight.ndim <= 1 or name.split(".")[0] in _OUTER
            (others if outer else hidden).append(weight)
        self.optimizers = [Muon(hidden, rate), torch.optim.AdamW(others, 0.5 * rate, betas=(0.9, 0.98))]
        for group in (g for optimizer in self.optimizers for g in optimizer.param_groups):
            group["full"] = group["lr"]
        self.step, self.elapsed = 0, 0.0

    def spend(self, minutes: float, files: list[Path], held: int, count: int, seed: int, out: Path) -> None:
        """Go on from OUT/last.pt and learn until the budget is spent, looking at `held` of the files now and then.

        Parameters
        ----------
        minutes
            Budget, resumed parts together.
        files, held, count
            Pictures; how many of them are only looked at; how many of the others a step takes.
        seed
            Of the pictures' order.
        out
            Folder of last.pt and metrics.csv.

        Raises
        ------
        InputError
            There are no more files than `held`.
        """
        if len(files) <= held:
            raise InputError(f"{len(files)} pictures; training needs more than the {held} that it looks at")
        last = out / "last.pt"
        if last.exists():
            self.load(last)
        rng = np.random.default_rng([seed, self.step])
        before = saved = time.monotonic()
        losses: list[Any] = []
        while self.elapsed < 60 * minutes:
            chosen = [files[n] for n in rng.integers(held, len(files), count)]
            losses.append(self.advance(chosen, self.elapsed / (60 * minutes), rng))
            now = time.monotonic()
            self.elapsed, before = self.elapsed + now - before, now
            if self.step % 100 == 0:
                self.look(out / "metrics.csv", np.mean(losses, axis=0), files[:held])
                losses, before = [], time.monotonic()
            if now - saved > 60:
                self.save(last)
                saved = now
        self.save(last)

    @abstractmethod
    def advance(self, files: list[Path], progress: float, rng: np.random.Generator) -> Any:
        """One step; its losses."""

    @abstractmethod
    def look(self, path: Path, losses: Any, files: list[Path]) -> None:
        """Add a row of metrics to the file `path`: mean losses, and what pictures never learned from say."""

    def pace(self, progress: float) -> None:
        """Set the learning rates of a step; `progress` is the share of the budget that is spent."""
        fall = min(1.0, (1 - min(progress, 1.0)) / (1 - _HOLD)) * min(1.0, (self.step + 1) / self.warm)
        for group in (g for optimizer in self.optimizers for g in optimizer.param_groups):
            group["lr"] = group["full"] * fall

    def learn(self) -> None:
        """Step along the gradients that have been gathered."""
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _STEEPEST, foreach=True)
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad()
        self.step += 1
        keep = min(self.keep, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.values()), list(self.network.state_dict().values()), 1 - keep)

    def save(self, path: Path) -> None:
        state = {
            "network": self.network.state_dict(), "average": self.average, "step": self.step, "elapsed": self.elapsed,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }  # fmt: skip
        with atomic.path(path) as beside:
            torch.save(state, beside)

    def load(self, path: Path) -> None:
        state = torch.load(path, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average, self.step, self.elapsed = state["average"], state["step"], state["elapsed"]
        for optimizer, held in zip(self.optimizers, state["optimizers"]):
            optimizer.load_state_dict(held)
