"""Benchmark of the stage `infer`: seconds and memory on crops of 512² and 2048², against the network alone.

    python tests/benchmarks/bench_infer.py DATA [--model MODEL.onnx] [--turns N]

The first picture of the evaluation at 512², and the same with each pixel four by four times. Each size in a
process of its own, for its peak memory; best of three.
"""

import argparse
import dataclasses
import multiprocessing
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from polcap.formats import onnx
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stage_values import Cues
from polcap.stages import infer
from polcap.stages.cues import CHANNELS, channels
from polcap.stages.infer import learned
from polcap.stages.infer.sizes_and_positions import OUTPUTS, run_network
from polcap.training.evaluation_protocol import Protocol


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with meshes/ and materials/")
    parser.add_argument("--model", type=Path, help="by default what is shipped, with its fine pass")
    parser.add_argument("--symmetries", type=int, default=infer.InferSettings().symmetries, help="positions averaged")
    options = parser.parse_args()
    seen = Protocol(options.data, 512).case(0).cues
    print("| crop | stage [s] | network once [s] | ratio | peak memory [GB] |\n| --- | --- | --- | --- | --- |")
    for times in (1, 4):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            stage, floor, peak = pool.apply(_measured, (_enlarged(seen, times), options.model, options.symmetries))
        print(f"| {512 * times}² | {stage:.2f} | {floor:.2f} | {stage / floor:.1f} | {peak:.2f} |", flush=True)


def _measured(seen: Cues, model: Path | None, symmetries: Literal[1, 2, 4, 8]) -> tuple[float, float, float]:
    """Best seconds of the stage, of one run of the network at its own size; greatest resident memory, GB."""
    network = models.load_network("network", model, "cpu", 0)
    assert network is not None
    small = learned._reduce(seen, int(network.metadata["native_size"]) / max(seen.mask.shape))
    settings = infer.InferSettings(symmetries=symmetries)
    floor = _best(lambda: run_network(channels(small), network, onnx.run, CHANNELS, OUTPUTS))
    stage = _best(lambda: infer.estimate(seen, network, onnx.run, settings))
    return stage, floor, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _best(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(3):
        before = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - before)
    return min(seconds)


def _enlarged(seen: Cues, times: int) -> Cues:
    """The same picture with `times`² pixels for each."""
    side = times * seen.mask.shape[0]

    def larger(image: Any) -> Any:
        return cv2.resize(image, (side, side), interpolation=cv2.INTER_NEAREST)

    x, y = seen.view.center
    centre = ((x + 0.5) * times - 0.5, (y + 0.5) * times - 0.5)
    view = dataclasses.replace(seen.view, focal=seen.view.focal * times, center=centre)
    changed: dict[str, Any] = {
        **{
            name: larger(getattr(seen, name))
            for name in ("radiance", "ratio_sigma", "dolp", "diffuse_color", "quality")
        },
        **{name: np.stack([larger(part) for part in getattr(seen, name)]) for name in ("ratio", "normalized_stokes")},
    }
    mask = larger(seen.mask.astype(np.uint8)) > 0
    return dataclasses.replace(seen, mask=mask, view=view, rays=frames.rays(view, side, side), **changed)


if __name__ == "__main__":
    main()
