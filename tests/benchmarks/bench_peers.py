"""polcap's steps beside other programs' on the same pixels, in one run: CPU seconds, ratios, errors.

    python tests/benchmarks/bench_peers.py FOLDER [--megapixels 6] [--out peers.json]

FOLDER is that of `bench_speed.py`, whose captures are made where they are missing. A peer that is not installed is
left out: `pip install HDRutils polanalyser` in an environment of its own, named with PYTHONPATH. Each figure is the
least of three calls, one thread each. Merging is counted with its decoding, in all processes.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import bench_speed
import cv2
import numpy as np

from polcap.formats import calib
from polcap.formats import capture as captures
from polcap.images import Alignment, AngleStack, Capture, ChartRequest, Floats, Gains, ObjectMask
from polcap.stages import align, hdr, stokes, whitebalance

_FULL = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])  # binned px → RAW px
_ECC = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)


@dataclass(frozen=True)
class Row:
    """One step, ours and theirs."""

    step: str
    peer: str
    ours: float  # CPU s
    theirs: float  # CPU s
    note: str = ""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("--megapixels", type=float, default=6)
    options.add_argument("--out", type=Path, default=Path("peers.json"))
    given = options.parse_args()
    cv2.setNumThreads(1)
    folder = bench_speed.made(given.folder, given.megapixels)
    capture = captures.read(folder)
    stack = hdr.merge(capture, hdr.Settings())
    rows = []
    for row in chain(solving(stack), registering(stack, folder), merging(capture)):
        print(table([row]), file=sys.stderr)
        rows.append(row)
    given.out.write_text(json.dumps([vars(row) for row in rows], indent=1) + "\n")
    print(table(rows))


def merging(capture: Capture) -> Iterator[Row]:
    """One bracket, files to radiance."""
    try:
        import HDRutils
    except ModuleNotFoundError:
        return

    shot = capture.shots[0]
    one = replace(capture, shots=(shot,))
    files = [frame.path for frame in shot.frames]
    theirs = least(lambda: HDRutils.merge(files, do_align=False), times=1)
    yield Row("merge of a bracket", "HDRutils", least(lambda: hdr.merge(one, hdr.Settings()), times=1), theirs)


def registering(stack: AngleStack, folder: Path) -> Iterator[Row]:
    """Every shot on the first; the error is the rms over a grid of points, px of the merged picture."""
    truth = json.loads((folder / "truth.json").read_text())
    per_shot = len(truth["files"]) // len(stack.angle)
    true = [np.array(truth["files"][k * per_shot]["transform"]) for k in range(len(stack.angle))]
    grey = [np.log(np.maximum(shot.sum(-1), 0) + 1e-3).astype(np.float32) for shot in stack.value]
    found: list[Floats] = []

    def ecc() -> None:
        found.clear()
        for other in grey[1:]:
            motion = np.eye(2, 3, dtype=np.float32)
            cv2.findTransformECC(grey[0], other, motion, cv2.MOTION_EUCLIDEAN, _ECC)
            found.append(np.vstack([motion, [0, 0, 1]]))

    theirs = least(ecc)
    color = whitebalance.measure(stack, calib.colorchecker(), ChartRequest("none"), whitebalance.Settings())
    ours = least(lambda: align.register(stack, color, align.Settings()))
    own = align.register(stack, color, align.Settings()).transform[1:]
    size = stack.value.shape[1:3]
    errors = [", ".join(f"{_error(m, t, size):.3f}" for m, t in zip(some, true[1:])) for some in (own, found)]
    yield Row("registration", "cv2.findTransformECC", ours, theirs, f"error {errors[0]} px, theirs {errors[1]} px")


def solving(stack: AngleStack) -> Iterator[Row]:
    """Stokes parameters of the whole frame, three channels; ours with covariance and quality."""
    try:
        import polanalyser
    except ModuleNotFoundError:
        return

    shots, (height, width) = len(stack.angle), stack.value.shape[1:3]

    def theirs() -> None:
        found = polanalyser.calcStokes(list(stack.value), [polanalyser.polarizer(angle) for angle in stack.angle])
        polanalyser.cvtStokesToDoLP(found)
        polanalyser.cvtStokesToAoLP(found)

    one, none = np.ones((shots, 3)), np.zeros((shots, 3))
    gains = Gains(
        gain=one,
        sigma=none,
        anchor=one,
        source="none",
        disagreement=0.0,
        angle_offset=0.0,
        angle_offset_sigma=0.0,
        angle_correction=0.0,
        concentration=1.0,
        order=tuple(range(shots)),
        mirrored=False,
        anchor_sigma=one[:, 0],
        grey_slope=1.0,
        chart_gloss=0.0,
    )
    whole = ObjectMask(np.ones((height, width), bool), (0, 0, width, height), "user")
    still = np.stack([np.eye(3)] * shots)
    moved = still.copy()
    moved[1:, :2, 2] = 0.4, -0.7
    cost = least(theirs)
    for name, transform in (("in place", still), ("resampled", moved)):
        at = Alignment(transform, np.zeros(shots), np.ones(shots))
        ours = least(lambda at=at: stokes.solve(stack, at, gains, whole, stokes.Settings()))  # type: ignore[misc]
        yield Row(f"Stokes, {name}", "polanalyser", ours, cost, "ours with covariance and quality bits")


def _error(found: Floats, true: Floats, size: tuple[int, ...]) -> float:
    """Rms distance between two transforms of the merged picture; `true` is between RAW pixels."""
    height, width = size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    binned = np.linalg.inv(_FULL) @ true @ _FULL
    there, stated = found @ points, binned @ points
    return float(np.sqrt(((there[:2] / there[2] - stated[:2] / stated[2]) ** 2).sum(0).mean()))


def least(work: Callable[[], Any], times: int = 3) -> float:
    """CPU seconds of this process and its children."""
    best = np.inf
    for _ in range(times):
        before, begun = bench_speed.tree_cpu(), time.process_time()
        work()
        children = bench_speed.tree_cpu() - before
        best = min(best, children if children > 1 else time.process_time() - begun)  # the table of processes is coarse
    return float(best)


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = ["| step | peer | polcap, CPU s | peer, CPU s | times as fast | |", "|" + " --- |" * 6]
    for row in rows:
        figures = f"{row.ours:.3f} | {row.theirs:.3f} | {row.theirs / row.ours:.2f}"
        lines.append(f"| {row.step} | {row.peer} | {figures} | {row.note} |")
    return "\n".join([*lines, f"\nPython {sys.version.split()[0]}, OpenCV {cv2.__version__}\n"])


if __name__ == "__main__":
    main()
