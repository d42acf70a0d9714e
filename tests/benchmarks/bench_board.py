"""Benchmark of the board: errors of its corners, of the poses, and of the masks after its print is erased.

    polcap synth SESSION --views 12 --mesh FILE
    python tests/benchmarks/bench_board.py SESSION

Prints a row per view: corners found, their rms error and residual [RAW px], error of the rotation and of the object's
projection, overlap (IoU) of the object's mask with the true one without and with the eraser, CPU seconds of detection
and eraser. Views that are not yet processed are processed as far as `align`.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats import onnx
from polcap.formats.capture import reader
from polcap.fusion import board_corners, board_eraser, poses
from polcap.fusion.board_corners import BoardCorners
from polcap.fusion.board_eraser import PosedBoard
from polcap.image_values import Bools, Floats, View
from polcap.optics import projection
from polcap.pipeline import models, run
from polcap.pipeline.path import UserInput
from polcap.results import ResultsUntilAlign
from polcap.stage_values import AngleStack
from polcap.stages import mask
from polcap.stages.mask import MaskSettings

_AROUND = 0.03 * np.array([[1, 1, 0], [-1, 1, 0], [0, 1, 1], [0, 2, 0], [0, 3, -1]], float)  # m, points of the object


def aligned(folder: Path) -> ResultsUntilAlign:
    """Results of a view up to `align`."""
    out = folder / "polcap"
    if not (out / "work" / "03-align").exists():
        run.process(reader.read(folder), UserInput(ChartRequest("none")), Config(), out, until="align")
    return run.reopen(out, ResultsUntilAlign)[0]


def overlap(radiance: AngleStack, results: ResultsUntilAlign, true: Bools) -> float:
    found = mask.segment(
        radiance, results.alignment, results.color, None, models.load_mask_network(1), onnx.run, MaskSettings()
    ).mask
    return float((found & true).sum() / (found | true).sum())


def corners_of(results: ResultsUntilAlign) -> BoardCorners:
    found = board_corners.detect(results.radiance, results.color).corners
    assert found is not None
    return found


def rms(error: Floats) -> float:
    return float(np.sqrt(2 * np.mean(error**2)))


def main(session: Path) -> None:
    truth = json.loads((session / "truth.json").read_text())
    camera = View(truth["focal_px"], tuple(truth["principal_px"]), 1.0)
    results, seen, seconds = {}, {}, {}
    for one in truth["views"]:
        name = one["name"]
        results[name] = aligned(session / name)
        start = time.process_time()
        seen[name] = corners_of(results[name])
        seconds[name] = time.process_time() - start
    solved = poses.solve(seen, reader.read(session / truth["views"][0]["name"]))
    print(f"focal length {solved.camera.focal_px:.1f} ± {solved.camera.focal_sigma_px:.1f} px, true {camera.focal:.1f}")
    print("view corners error_px residual_px turn_deg object_px IoU_plain IoU_erased detect_s erase_s")
    for one in truth["views"]:
        name, turn, shift = one["name"], np.array(one["rotation"]), np.array(one["translation"])
        corners, view, result = seen[name], solved.views[name], results[name]
        error = corners.measured_px - projection.project(camera, corners.world @ turn.T + shift)
        true_px = projection.project(camera, _AROUND @ turn.T + shift)
        moved = solved.camera.project(view.pose, _AROUND) - true_px
        cosine = (np.trace(view.pose.rotation @ turn.T) - 1) / 2
        start = time.process_time()
        erased = board_eraser.erase(
            result.radiance, result.alignment, result.color, PosedBoard(corners.board, solved.camera, view.pose)
        )
        spent = time.process_time() - start
        with np.load(session / name / "truth.npz") as maps:
            full = maps["mask"]
        true = full.reshape(full.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3)) > 0.5
        print(
            f"{name} {len(corners.number)} {rms(error):.3f} {view.residual_px:.3f} "
            f"{np.degrees(np.arccos(min(cosine, 1.0))):.3f} {rms(moved):.3f} "
            f"{overlap(result.radiance, result, true):.3f} {overlap(erased, result, true):.3f} "
            f"{seconds[name]:.2f} {spent:.2f}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
