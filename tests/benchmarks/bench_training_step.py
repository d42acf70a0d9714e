"""Benchmark of a training step of the main network on one CPU thread: seconds by part, pictures per second by size.

    taskset -c 0 python tests/benchmarks/bench_training_step.py MODEL.onnx $POLCAP_DATA

Views of sixteen random shapes are traced first. Prints a Markdown row per size of the pictures, medians of five steps.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from polcap.training import loss, main_network, materials, traced_views, train
from polcap.training.simulator import Simulator

STEPS = 5
PRESET = train.PRESETS["cpu"]
PARTS = ("simulator", "forward", "loss and gradient", "optimizers")


def main() -> None:
    model, data = map(Path, sys.argv[1:3])
    torch.set_num_threads(1)
    device = torch.device("cpu")
    training = train.NetworkTraining(PRESET.shape, device, rate=1e-4)
    training.begin(model)
    with tempfile.TemporaryDirectory() as folder:
        recipe = traced_views.ViewsRecipe(views=1, procedural=16, size=PRESET.size, seed=13)
        cache = traced_views.open_cache(Path(folder), [], recipe)
        simulator = Simulator(cache, materials.MaterialLibrary(data / "materials" / "train", device), device)
        print("| px | pictures | s:", ", ".join(PARTS), "| pictures/s |\n| --- | --- | --- | --- |")
        for size in PRESET.sizes:
            count = PRESET.pixels // size**2
            seconds = np.median([step(training, simulator, count, size) for _ in range(STEPS)], axis=0)
            parts = ", ".join(f"{value:.2f}" for value in seconds)
            print(f"| {size} | {count} | {parts} | {count / seconds.sum():.2f} |", flush=True)


def step(training: train.NetworkTraining, simulator: Simulator, count: int, size: int) -> list[float]:
    """Seconds of each of the PARTS of one step."""
    times = [time.perf_counter()]
    batch = simulator.draw_batch(count, size)
    times.append(time.perf_counter())
    maps = main_network.run(training.network, batch.channels)
    times.append(time.perf_counter())
    value, _ = loss.total(maps, batch, training.lights[0])
    for weight, gradient in zip(training.weights, torch.autograd.grad(value, training.weights)):
        weight.grad = gradient
    times.append(time.perf_counter())
    training.update(progress=0.1)
    times.append(time.perf_counter())
    return np.diff(times).tolist()


if __name__ == "__main__":
    main()
