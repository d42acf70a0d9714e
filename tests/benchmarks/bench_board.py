"""Benchmark of the board: errors of its corners, of the poses, and of the masks after its print is erased.

    polcap synth SESSION --views 12 --mesh FILE
    python tests/benchmarks/bench_board.py SESSION

Prints a row per view: corners found, their rms error and residual [RAW px], error of the rotation and of the object's
projection, overlap (IoU) of the object's mask with the true one without and with the eraser, CPU seconds of detection
and eraser. Views that are not yet processed are processed as far as `align`.
"""

import json
import sys
from functools import partial
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
from tests.experiments import overlap, timed

_AROUND = 0.03 * np.array([[1, 1, 0], [-1, 1, 0], [0, 1, 1], [0, 2, 0], [0, 3, -1]], float)  # m, points of the object


def aligned(folder: Path) -> ResultsUntilAlign:
    """Results of a view up to `align`."""
    out = folder / "polcap"
    if not (out / "work" / "03-align").exists():
        run.process(reader.read(folder), UserInput(ChartRequest("none")), Config(), out, until="align")
    return run.reopen(out, ResultsUntilAlign)[0]


def mask_overlap(radiance: AngleStack, results: ResultsUntilAlign, true: Bools) -> float:
    """Overlap (IoU) of the object's mask with the true one."""
    network, settings = models.load_mask_network(1), MaskSettings()
    return overlap(
        mask.segment(radiance, results.alignment, results.color, None, network, onnx.run, settings).mask, true
    )


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
        seen[name], seconds[name] = timed(partial(corners_of, results[name]))
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
        board = PosedBoard(corners.board, solved.camera, view.pose)
        erase = partial(board_eraser.erase, result.radiance, result.alignment, result.color, board)
        erased, spent = timed(erase)
        with np.load(session / name / "truth.npz") as maps:
            full = maps["mask"]
        true = full.reshape(full.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3)) > 0.5
        print(
            f"{name} {len(corners.number)} {rms(error):.3f} {view.residual_px:.3f} "
            f"{np.degrees(np.arccos(min(cosine, 1.0))):.3f} {rms(moved):.3f} "
            f"{mask_overlap(result.radiance, result, true):.3f} {mask_overlap(erased, result, true):.3f} "
            f"{seconds[name]:.2f} {spent:.2f}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
