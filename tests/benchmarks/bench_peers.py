"""Benchmark against other programs: CPU seconds and errors of single steps on the same pixels.

    python tests/benchmarks/bench_peers.py FOLDER [--megapixels 6] [--out peers.json]

FOLDER is that of `bench_speed.py`, whose captures are made where they are missing. A peer that is not installed is
left out: `pip install HDRutils polanalyser dbini-torch colour-checker-detection` in an environment of its own, named
with PYTHONPATH. A figure is the least of three calls, one thread each. Merging is the mean of ten, counted with its
decoding, in all processes, and less LibRaw's unpacking. hdrmerge (with QT_QPA_PLATFORM=offscreen) and
align_image_stack are of Debian's hdrmerge and hugin-tools.
"""

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import bench_speed
import cv2
import numpy as np

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.formats import shipped_data
from polcap.formats.capture import reader as captures
from polcap.formats.raw import frame_decoder
from polcap.image_values import Floats, View
from polcap.stage_values import Alignment, AngleStack, ObjectMask, SelfCalibration, SurfaceMaps
from polcap.stages import align, hdr, stokes, surface, whitebalance
from polcap.stages.whitebalance import WhitebalanceSettings
from tests import experiments, scenes
from tests.experiments import arguments, plain_maps, rms

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
    options = arguments(__doc__, "folder", megapixels=6.0, out=Path("peers.json"))
    cv2.setNumThreads(1)
    folder = bench_speed.made(options.folder, options.megapixels)
    capture = captures.read(folder)
    stack = hdr.merge(capture, frame_decoder.decode, hdr.HdrSettings())
    rows = []
    for row in chain(solving(stack), charting(stack), registering(stack, folder), merging(capture), integrating()):
        print(table([row]), file=sys.stderr)
        rows.append(row)
    options.out.write_text(json.dumps([vars(row) for row in rows], indent=1) + "\n")
    print(table(rows))


def merging(capture: Capture) -> Iterator[Row]:
    """One bracket, files to radiance; without decoding: polcap's own process; the peer less LibRaw's unpacking."""
    shot = capture.shots[0]
    one = replace(capture, shots=(shot,))
    files = [frame.path for frame in shot.frames]
    unpacking = least(lambda: [bench_speed.unpack(file) for file in files])
    ours, here = _merges(one)
    for peer, work in (("HDRutils", partial(_hdrutils, files)), ("hdrmerge", partial(_hdrmerge, files))):
        theirs = work()
        if theirs is not None:
            yield Row("merge of a bracket", peer, ours, theirs)
            yield Row("merge without decoding", peer, here, theirs - unpacking)


def _merges(capture: Capture, times: int = 10) -> tuple[float, float]:
    """CPU seconds of one of several merges, its decoders' among them, and of this process alone."""
    hdr.merge(capture, frame_decoder.decode, hdr.HdrSettings())
    before, here = bench_speed.tree_cpu(), time.process_time()
    for _ in range(times):
        hdr.merge(capture, frame_decoder.decode, hdr.HdrSettings())
    return (bench_speed.tree_cpu() - before) / times, (time.process_time() - here) / times


def _hdrutils(files: list[str]) -> float | None:
    try:
        import HDRutils
    except ModuleNotFoundError:
        return None
    return least(lambda: HDRutils.merge(files, do_align=False), times=1)


def _hdrmerge(files: list[str]) -> float | None:
    if shutil.which("hdrmerge") is None:
        return None
    with tempfile.TemporaryDirectory() as place:
        return bench_speed.cpu_of(["hdrmerge", "--no-align", "-o", f"{place}/merged.dng", *files])


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
    ours = least(lambda: align.register(stack, align.AlignSettings()))
    own = align.register(stack, align.AlignSettings()).transform[1:]
    size = stack.value.shape[1:3]
    errors = [", ".join(f"{_error(m, t, size):.3f}" for m, t in zip(some, true[1:])) for some in (own, found)]
    yield Row("registration", "cv2.findTransformECC", ours, theirs, f"error {errors[0]} px, theirs {errors[1]} px")
    if shutil.which("align_image_stack") is not None:
        theirs, left = _align_image_stack(grey)
        yield Row("registration", "align_image_stack", ours, theirs, f"left by theirs, as ECC sees it: {left} px")


def _align_image_stack(grey: list[Floats]) -> tuple[float, str]:
    """CPU seconds, and what is left of the shots' shifts in its own aligned pictures, px."""
    low, high = np.percentile(grey[0], (0.1, 99.9))
    with tempfile.TemporaryDirectory() as place:
        files = [f"{place}/shot{k}.tif" for k in range(len(grey))]
        for file, shot in zip(files, grey):
            cv2.imwrite(file, np.uint8(np.clip((shot - low) / (high - low), 0, 1) * 255))
        command = ["align_image_stack", "-f", "30", "--corr=0.8", "-t", "1"]
        theirs = bench_speed.cpu_of([*command, "-p", f"{place}/found.pto", *files])
        bench_speed.cpu_of([*command, "-a", f"{place}/out", *files])
        first, *others = (np.asarray(cv2.imread(str(file), 0)) for file in sorted(Path(place).glob("out*.tif")))
    left = []
    assert first is not None
    for other in others:
        assert other is not None
        motion = np.eye(2, 3, dtype=np.float32)
        cv2.findTransformECC(first, other, motion, cv2.MOTION_EUCLIDEAN, _ECC)
        left.append(_apart(np.vstack([motion, [0, 0, 1]]), np.eye(3), first.shape))
    return theirs, ", ".join(f"{one:.3f}" for one in left)


def charting(stack: AngleStack) -> Iterator[Row]:
    """The chart in the first shot; ours with the matrix, every patch predicted, and the light's place."""
    try:
        from colour_checker_detection import detect_colour_checkers_segmentation
    except ModuleNotFoundError:
        return

    value = stack.value[0]
    shown = np.clip(value / np.percentile(value, 99.5, axis=(0, 1)), 0, 1).astype(np.float32) ** np.float32(1 / 2.2)
    found = len(detect_colour_checkers_segmentation(shown))
    theirs = least(lambda: detect_colour_checkers_segmentation(shown))
    reference, search = shipped_data.colorchecker(), ChartRequest("auto")
    ours = least(lambda: whitebalance.measure(stack, reference, search, WhitebalanceSettings()))
    note = f"theirs finds {found}, ours with its matrix and doubt"
    yield Row("chart found and fitted", "colour-checker-detection", ours, theirs, note)


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

    equal = scenes.equal(stack.angle)
    whole = ObjectMask(np.ones((height, width), bool), (0, 0, width, height), "user")
    still = np.stack([np.eye(3)] * shots)
    moved = still.copy()
    moved[1:, :2, 2] = 0.4, -0.7
    cost = least(theirs)
    # as theirs has it: a superpixel's colors are taken as seen in its middle
    as_given = replace(stack, sensor=replace(stack.sensor, site_px=None))
    for name, given, transform in (
        ("nothing resampled", as_given, still),
        ("colors laid over one another", stack, still),
        ("every shot resampled", stack, moved),
    ):
        solve = partial(_solved, given, Alignment(transform, np.zeros(shots), np.ones(shots)), equal, whole)
        yield Row(f"Stokes, {name}", "polanalyser", least(solve), cost, "ours with covariance and quality bits")


def _solved(stack: AngleStack, at: Alignment, calibration: SelfCalibration, object_: ObjectMask) -> None:
    stokes.solve(stack, at, calibration, object_, stokes.StokesSettings())


def integrating() -> Iterator[Row]:
    """Depth of one ball before another from true normals, 192²; the error is the rms of ln depth about its median."""
    try:
        import torch
        from dbini_torch import bilateral_normal_integration
    except ModuleNotFoundError:
        return

    torch.set_num_threads(1)
    maps, true = _balls(192)
    view = maps.view
    camera = torch.tensor([[view.focal, 0, view.center[0]], [0, view.focal, view.center[1]], [0, 0, 1]])
    normal, mask = torch.from_numpy(maps.normal.transpose(2, 0, 1).copy()), torch.from_numpy(maps.mask)
    found: list[Floats] = []

    def theirs() -> None:
        found[:] = [np.asarray(bilateral_normal_integration(normal, mask, K=camera)[0])]

    cost = least(theirs, times=1)
    ours = least(lambda: surface.integrate(maps, None, surface.SurfaceSettings()))
    own = surface.integrate(maps, None, surface.SurfaceSettings()).depth
    ratios = [np.log(depth[maps.mask] / true[maps.mask]) for depth in (own, found[0])]
    errors = [rms(ratio - np.median(ratio)) for ratio in ratios]
    note = f"error {errors[0]:.4f}, theirs {errors[1]:.4f}; ours with the mesh"
    yield Row("depth of 192² from normals", "dbini-torch", ours, cost, note)


def _balls(side: int) -> tuple[SurfaceMaps, Floats]:
    """Maps of a ball before a larger one, and their depth."""
    view = View(1.75 * side, ((side - 1) / 2, (side - 1) / 2), 1.0, (0.0, 0.0))
    row, column = np.mgrid[:side, :side]
    ray = np.stack(
        [(column - view.center[0]) / view.focal, -(row - view.center[1]) / view.focal, -np.ones((side, side))], axis=-1
    )
    depth, normal = np.full((side, side), np.inf), np.zeros((side, side, 3))
    for center, radius in (((0.02, 0.02, -0.7), 0.14), ((-0.03, -0.02, -0.5), 0.04)):
        along, square = ray @ np.array(center), np.sum(ray * ray, axis=-1)
        root = along**2 - square * (np.dot(center, center) - radius**2)
        at = (along - np.sqrt(np.maximum(root, 0))) / square
        nearer = (root > 0.03 * radius**2) & (at < depth)
        depth[nearer] = at[nearer]
        normal[nearer] = (((ray * at[..., None]) - center) / radius)[nearer]
    mask = np.isfinite(depth)
    return plain_maps(normal.astype(np.float32), mask, view, error_deg=3.0), depth


def _error(found: Floats, true: Floats, size: tuple[int, ...]) -> float:
    """Rms distance between two transforms of the merged picture; `true` is between RAW pixels."""
    return _apart(found, np.linalg.inv(_FULL) @ true @ _FULL, size)


def _apart(found: Floats, true: Floats, size: tuple[int, ...]) -> float:
    """Rms distance over a grid of points."""
    height, width = size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    there, stated = found @ points, true @ points
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
    names = ("step", "peer", "polcap, CPU s", "peer, CPU s", "times as fast", "")
    cells = [(one.step, one.peer, one.ours, one.theirs, one.theirs / one.ours, one.note) for one in rows]
    return f"{experiments.table(cells, names)}\n\nPython {sys.version.split()[0]}, OpenCV {cv2.__version__}\n"


if __name__ == "__main__":
    main()
