"""Common parts of benchmarks and campaigns: options, rows in a file, tables, times, results against the truth."""

import argparse
import json
import os
import resource
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import replace

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats.capture import reader
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Floats, View
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.quality import gates
from polcap.quality.gate_values import Gate, full_size
from polcap.results import R, Results
from polcap.stage_values import Network, SurfaceMaps
from polcap.synth import scenes, shooting
from polcap.synth.render import Scene

T = TypeVar("T")
Networks = tuple[Network | None, Network | None]  # of the normals, of the mask


class Rows:
    """Rows of a campaign in a file, one JSON object a line, so that it can continue; without a file they are lost."""

    def __init__(self, file: str | Path | None = None) -> None:
        self._file = Path(file) if file else None
        lines = self._file.read_text(encoding="utf-8").splitlines() if self._file and self._file.exists() else []
        self.all: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, row: dict[str, Any]) -> None:
        """Store a row on the disk, whatever ends the campaign."""
        self.all.append(row)
        if self._file is None:
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def done(self, *keys: str) -> set[tuple[Any, ...]]:
        """Values of these columns in all rows."""
        return {tuple(row.get(key) for key in keys) for row in self.all}


def arguments(text: str | None, *names: str, **usual: Any) -> argparse.Namespace:
    """Read the command line: `names` are paths ("folder") and flags ("--rough"); `usual` are options with defaults.

    A type as default means None, a tuple the choices, the usual one first, and a list any number of words.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in names:
        parser.add_argument(name, **({"action": "store_true"} if name.startswith("--") else {"type": Path}))
    for name, value in usual.items():
        how: dict[str, Any] = {"type": type(value), "default": value}
        if isinstance(value, type):
            how = {"type": value}
        elif isinstance(value, tuple):
            how = {"choices": value, "default": value[0]}
        elif isinstance(value, list):
            how = {"nargs": "*", "default": value, "type": type(value[0]) if value else str}
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    return parser.parse_args()


def row(*cells: object) -> str:
    """A row of a Markdown table; floats with three digits."""
    return f"| {' | '.join(f'{cell:.3g}' if isinstance(cell, float) else str(cell) for cell in cells)} |"


def head(*names: str) -> str:
    """The head of a Markdown table."""
    return f"{row(*names)}\n{row(*['---'] * len(names))}"


def table(rows: Sequence[Sequence[Any]], names: Sequence[str]) -> str:
    """A Markdown table."""
    return "\n".join([head(*names), *(row(*one) for one in rows)])


def processor_s() -> float:
    """Processor time of this process and of its children that ended."""
    return sum(os.times()[:4])


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """Result of a call, and its seconds of processor time in this process."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def peak_mb() -> float:
    """Greatest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def data() -> Path:
    """The folder of meshes, materials and photographs, $POLCAP_DATA."""
    return Path(os.environ["POLCAP_DATA"])


def small_capture(folder: Path, seed: int = 0) -> None:
    """Write a capture of 320 × 240 px in one exposure, which `polcap process` finishes in three seconds."""
    shoot = shooting.Shoot(seed=seed, width=320, height=240, samples=1, exposures=1)
    shooting.write(folder, scenes.random_scene(seed, "bumps"), shoot)


def with_materials(scene: Scene, **changes: Any) -> Scene:
    """A scene with these fields of all its materials changed."""
    changed = tuple(replace(one, **changes) for one in scene.coat.materials)
    return replace(scene, coat=replace(scene.coat, materials=changed))


@cache
def networks(estimator: Any = None, model: Path | None = None) -> Networks:
    """The networks of normals and mask on one thread, shipped ones unless a model is named."""
    return models.load_network(estimator, model, "cpu", 1), models.load_mask_network(1)


def process(capture: Capture, wanted: type[R], using: Networks | None = None, chart: Any = "auto") -> R:
    """Results of the path in memory, up to the last stage of the `wanted` ones."""
    supplied = UserInput(ChartRequest(chart), None, *(using or networks()))
    return path(capture, supplied, Config(), MemoryCache(), wanted)


def judge(folder: Path, using: Networks | None = None, chart: Any = "auto") -> tuple[Results, list[Gate]]:
    """Results of the path on a capture, and its gates."""
    capture = reader.read(folder)
    found = process(capture, Results, using, chart)
    return found, gates.judge(full_size(found, capture.focal_doubt), Config().gates)


def raw_pixels(maps: SurfaceMaps) -> tuple[int, tuple[slice, slice]]:
    """RAW pixels per pixel of the maps, and the rows and columns of RAW pixels that the maps cover."""
    step, (x, y) = round(maps.view.scale), (round(maps.view.scale * at) for at in maps.view.origin)
    height, width = maps.mask.shape
    return step, np.s_[y : y + step * height, x : x + step * width]


def rms(error: Floats) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def overlap(one: Bools, other: Bools) -> float:
    """Intersection over union (IoU) of two masks."""
    return float((one & other).sum() / max((one | other).sum(), 1))


def plain_maps(normal: Floats, mask: Bools, view: View, error_deg: float) -> SurfaceMaps:
    """Maps with these normals (H, W, 3), their expected error, and one material."""
    flat = np.ones(mask.shape, np.float32)
    color = flat[..., None].repeat(3, axis=-1)
    return SurfaceMaps(normal, color / 2, color / 25, flat / 2, None, error_deg * flat, mask, view, "truth")


def true_pose(stated: dict[str, Any]) -> Pose:
    """A pose of truth.json."""
    return Pose(np.array(stated["rotation"]), np.array(stated["translation"]))
