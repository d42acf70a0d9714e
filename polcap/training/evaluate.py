"""Evaluation of a model, `polcap evaluate`: errors of all maps on the protocol's pictures, and of baselines.

Cues and inference are computed by the same code as for captures. Pictures are divided among the cores. The result of
each picture is stored in out/pictures.jsonl, so that a stopped run can continue.
"""

import hashlib
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polcap.formats import atomic, onnx, own_files, text_file
from polcap.formats.maps import png
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stage_values import Cues, Network, SurfaceMaps
from polcap.stages import cues, infer
from polcap.training import evaluation_baselines, evaluation_page, evaluation_protocol
from polcap.training.evaluation_baselines import Estimator, Means
from polcap.training.evaluation_protocol import Protocol
from polcap.training.map_errors import MAPS, Judge, deciles
from polcap.training.progress import Report, silent
from polcap.training.scores import Score, mean_score

_FILES = ("evaluation.json", "evaluation.md", "panel.png", "pictures.jsonl")
_PANEL = 8  # pictures in panel.png
_SAMPLE = 500  # pixels of a picture for the check of the expected error
_MIN_SHARE = 3  # least number of pictures per process
OURS, CLEAN, ANALYTIC, MEAN = "ours", "ours, noise-free", "analytic", "mean of each map"
_INTEGRATED = (OURS, CLEAN, ANALYTIC)  # columns with an error of the depth from their normals
_ALONE = ", network alone"  # end of the names of the second table's columns; "ours" is in both tables

Row = dict[str, Any]


@dataclass(frozen=True)
class EvaluationOptions:
    """One evaluation; a field for each option of `polcap evaluate`."""

    model: Path
    data: Path = Path("data")
    out: Path = Path("runs/evaluate")
    ablations: Path | None = None  # holds NAME/last.pt
    count: int = evaluation_protocol.COUNT  # pictures
    size: int = evaluation_protocol.SIZE  # px
    protocol: int = 1  # 1 | 2, of evaluation_protocol.py


def main(options: EvaluationOptions, report: Report = silent) -> dict[str, Score]:
    """Evaluate model and baselines; returns mean scores, writes evaluation.json, evaluation.md and panel.png.

    Raises StorageError: options.out holds files of these names that polcap did not write.
    """
    torch.set_num_threads(1)
    network = models.open_network(options.model)
    protocol = Protocol(options.data, options.size, options.protocol)
    with own_files.claimed(options.out, _FILES):
        return _evaluate(options, network, protocol, report)


def _evaluate(options: EvaluationOptions, network: Network, protocol: Protocol, report: Report) -> dict[str, Score]:
    """The evaluation of `main`, once its folder is claimed."""
    head = _head(options, network, protocol.subjects)
    rows = _evaluate_pictures(options, evaluation_baselines.mean_maps(protocol, options.count), head, report)
    result = _summary(head, rows)
    cases = (protocol.case(number) for number in range(min(_PANEL, options.count)))
    strips = [evaluation_page.make_row(case, _estimate(case.cues, network)) for case in cases]
    png.write(options.out / "panel.png", evaluation_page.make_sheet(strips))
    atomic.write_json(options.out / "evaluation.json", result)
    atomic.write(options.out / "evaluation.md", evaluation_page.make_page(result))
    return {**result["table"], **result["ablations"]}


def _head(options: EvaluationOptions, network: Network, subjects: str) -> dict[str, Any]:
    """The settings and digests that identify an evaluation: if one changes, earlier results are not used again."""
    digest = hashlib.sha256()
    tests = [(options.data / "meshes" / "test").glob("*.npz"), (options.data / "materials" / "test").glob("*/*")]
    for file in sorted(file for files in tests for file in files):
        digest.update(file.relative_to(options.data).as_posix().encode() + file.read_bytes())
    found = evaluation_baselines.find_checkpoints(options.ablations)
    return {
        "pictures": options.count, "size": options.size, "subjects": subjects,
        "protocol": f"{options.protocol}.{evaluation_protocol.VERSION}",
        "materials": evaluation_protocol.PROTOCOLS[options.protocol], "camera": evaluation_protocol.CONDITIONS,
        "model": network.digest, "version": network.metadata.get("version", ""), "data": digest.hexdigest(),
        "stages": {stage.name: stage.version for stage in (cues.compute, infer.estimate)},
        "ablations": {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()},
    }  # fmt: skip


def _estimate(seen: Cues, network: Network | None) -> SurfaceMaps:
    """Estimate the maps of one picture by the stage `infer`; without a network by the analytic estimator alone."""
    return infer.estimate(seen, network, onnx.run, infer.InferSettings())


def _evaluate_pictures(options: EvaluationOptions, means: Means, head: dict[str, Any], report: Report) -> list[Row]:
    """Results of all evaluation pictures; stored ones of an earlier run with the same inputs are used again."""
    path = options.out / "pictures.jsonl"
    rows = _read_results(path, head)
    atomic.write(path, "".join(json.dumps(row) + "\n" for row in [head, *rows]))
    started, first = time.monotonic(), len(rows)
    with path.open("a") as file:
        for row in _evaluate_range(options, means, range(first, options.count)):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
            each = (time.monotonic() - started) / (len(rows) - first)
            left = each * (options.count - len(rows)) / 60
            mean = np.mean([row["scores"][OURS]["normal_mean"] for row in rows])
            report(
                f"{len(rows)}/{options.count}  {each:.1f} s per picture, {left:.0f} min left; "
                f"{OURS}: normals {mean:.2f}° on average"
            )
    return rows


def _read_results(path: Path, head: dict[str, Any]) -> list[Row]:
    """Read results from pictures.jsonl of an earlier run with the same inputs; an unfinished last line is dropped."""
    lines = text_file.read_text(path, limit=1 << 30).splitlines(keepends=True) if path.exists() else []
    if not lines or lines[0] != json.dumps(head) + "\n":
        return []
    return [json.loads(line) for line in lines[1:] if line.endswith("\n")]


def _evaluate_range(options: EvaluationOptions, means: Means, numbers: range) -> Iterator[Row]:
    """Evaluate the pictures `numbers` in order, in one process per core if there are enough pictures."""
    workers = min(os.cpu_count() or 1, len(numbers) // _MIN_SHARE)
    row = partial(evaluate_picture, options, means)
    if workers < 2:
        yield from map(row, numbers)
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, spawn, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(row, numbers)


@cache
def _open(options: EvaluationOptions, means: Means) -> tuple[Protocol, dict[str, Estimator]]:
    """The evaluation's pictures, and the estimators to compare, by the name of their column."""
    network = models.open_network(options.model, threads=1)
    columns: dict[str, Estimator] = {
        OURS: lambda case: _estimate(case.cues, network),
        CLEAN: lambda case: _estimate(case.clean, network),
        ANALYTIC: lambda case: _estimate(case.cues, None),
        "frontal": lambda case: evaluation_baselines.frontal(case.cues),
        "silhouette": lambda case: evaluation_baselines.inflated(case.cues),
        MEAN: lambda case: evaluation_baselines.constant(case.cues, means),
    }
    for name, path in evaluation_baselines.find_checkpoints(options.ablations).items():
        columns[name + _ALONE] = evaluation_baselines.network_alone(path)
    return Protocol(options.data, options.size, options.protocol), columns


def evaluate_picture(options: EvaluationOptions, means: Means, number: int) -> Row:
    """Evaluate all estimators on one picture: scores, seconds, a sample of expected errors, moments of F0."""
    protocol, columns = _open(options, means)
    before = time.monotonic()
    case = protocol.case(number)
    seconds, scores = {"making the picture": time.monotonic() - before}, {}
    mask, judge, maps = case.truth.mask, Judge(case), {}
    for name, estimator in columns.items():
        before = time.monotonic()
        maps[name] = estimator(case)
        seconds[name] = time.monotonic() - before
    before = time.monotonic()
    for name, estimate in maps.items():
        scores[name] = judge.score(estimate) | (judge.integrated(estimate) if name in _INTEGRATED else {})
    seconds["scoring all"] = time.monotonic() - before
    some = np.random.default_rng(number).permutation(int(mask.sum()))[:_SAMPLE]
    errors = maps[OURS].confidence, frames.angle_deg(maps[OURS].normal, case.truth.normal)
    f0 = case.truth.specular[mask].astype(np.float64)
    return {
        "picture": number, "name": case.name, "scores": scores, "seconds": seconds,
        "calibration": [np.round(x[mask][some], 2).tolist() for x in errors],
        "f0": [float(f0.mean()), float((f0**2).mean())],
    }  # fmt: skip


def _summary(head: dict[str, Any], rows: list[Row]) -> dict[str, Any]:
    """Content of the evaluation: means over all pictures, calibration by deciles, scores of each picture."""
    mean = {name: mean_score([row["scores"][name] for row in rows]) for name in rows[0]["scores"]}
    f0, square = np.mean([row["f0"] for row in rows], axis=0)
    predicted, actual = (np.concatenate([row["calibration"][k] for row in rows]) for k in (0, 1))
    return {
        "conditions": head | {"f0_deviation": float(np.sqrt(square - f0**2))},
        "table": {name: score for name, score in mean.items() if not name.endswith(_ALONE)},
        "ablations": {name.removesuffix(_ALONE): score for name, score in mean.items() if name.endswith(_ALONE)},
        "of_mean_maps": {name: mean[OURS][name] / mean[MEAN][name] for name in MAPS},
        "calibration": deciles(predicted, actual),
        "seconds": mean_score([row["seconds"] for row in rows]),
        "pictures": [{"name": row["name"], "scores": row["scores"]} for row in rows],
    }
