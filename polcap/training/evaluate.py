"""Evaluation of a model, `polcap evaluate`: errors of all maps on the protocol's pictures, and of baselines.

Cues, inference and model file are those of captures. Each core evaluates other pictures. Results of pictures are
stored in out/pictures.jsonl, so that a stopped run can continue.
"""

import hashlib
import json
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polcap.formats import atomic, onnx
from polcap.formats.maps import png
from polcap.images import Cues, Network, SurfaceMaps
from polcap.pipeline import models
from polcap.stages import cues, infer
from polcap.training import evaluation_baselines, evaluation_page, evaluation_picture, evaluation_protocol
from polcap.training.evaluation_baselines import Estimator, Means
from polcap.training.evaluation_protocol import Protocol
from polcap.training.map_errors import MAPS, Judge, Score, angle, deciles

_PANEL = 8  # pictures in panel.png
_SAMPLE = 500  # pixels of a picture for the check of the expected error
_PROGRESS_S = 20  # s between two lines of progress
_MIN_SHARE = 3  # pictures per process
OURS, CLEAN, ANALYTIC, MEAN = "ours", "ours, noise-free", "analytic", "mean of each map"
_INTEGRATED = (OURS, CLEAN, ANALYTIC)  # columns with integrated normals

Row = dict[str, Any]


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of one evaluation."""

    model: Path
    data: Path = Path("data")
    out: Path = Path("runs/evaluate")
    ablations: Path | None = None  # holds NAME/last.pt
    count: int = evaluation_protocol.COUNT  # pictures
    size: int = evaluation_protocol.SIZE  # px
    protocol: int = 1  # 1 | 2, of evaluation_protocol.py


def main(options: EvaluationOptions) -> dict[str, Score]:
    """Evaluate the model and all baselines; writes evaluation.json, evaluation.md and panel.png to `out`."""
    torch.set_num_threads(1)
    network = models.open_network(options.model)
    found = {} if options.ablations is None else evaluation_baselines.find_checkpoints(options.ablations)
    head = _head(options, network, found)
    made = Protocol(options.data, options.size, options.protocol)
    rows = _evaluate_pictures(options, evaluation_baselines.mean_maps(made, options.count), head)
    result = _summary(head, rows, list(found))
    shown = (made.case(number) for number in range(min(_PANEL, options.count)))
    strips = [evaluation_picture.make_row(case, _estimate(case.cues, network)) for case in shown]
    for name, text in (
        ("evaluation.json", json.dumps(result, indent=1)),
        ("evaluation.md", evaluation_page.make_page(result)),
    ):
        with atomic.path(options.out / name) as temporary:
            temporary.write_text(text)
    png.write(options.out / "panel.png", evaluation_picture.make_sheet(strips))
    return {**result["table"], **result["ablations"]}


def _head(options: EvaluationOptions, network: Network, found: dict[str, Path]) -> dict[str, Any]:
    """All inputs of the figures."""
    return {
        "pictures": options.count, "size": options.size,
        "protocol": f"{options.protocol}.{evaluation_protocol.VERSION}",
        "materials": evaluation_protocol.PROTOCOLS[options.protocol], "camera": evaluation_protocol.CONDITIONS,
        "model": network.digest, "version": network.metadata.get("version", ""), "data": _digest(options.data),
        "stages": {stage.name: stage.version for stage in (cues.compute, infer.estimate)},
        "ablations": {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()},
    }  # fmt: skip


def _digest(data: Path) -> str:
    """SHA-256 of all test meshes and texture sets."""
    digest = hashlib.sha256()
    for file in sorted([*(data / "meshes" / "test").glob("*.npz"), *(data / "materials" / "test").glob("*/*")]):
        digest.update(file.relative_to(data).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def _network_alone(name: str) -> str:
    """Name of a column of the second table; "ours" is in both tables."""
    return f"{name}, network alone"


def _estimate(seen: Cues, network: Network | None) -> SurfaceMaps:
    """Maps by the inference stage; without a network by the analytic estimate alone."""
    return infer.estimate(seen, network, onnx.run, infer.InferSettings())


def _evaluate_pictures(options: EvaluationOptions, means: Means, head: dict[str, Any]) -> list[Row]:
    """Results of all pictures; those of an earlier run with the same inputs are used again."""
    path = options.out / "pictures.jsonl"
    rows = _read_results(path, head)
    with atomic.path(path) as temporary:
        temporary.write_text("".join(json.dumps(row) + "\n" for row in [head, *rows]))
    started = reported = time.monotonic()
    first = len(rows)
    with path.open("a") as file:
        for row in _evaluate_range(options, means, range(first, options.count)):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
            now = time.monotonic()
            if now - reported > _PROGRESS_S or len(rows) == options.count:
                reported = now
                each = (now - started) / (len(rows) - first)
                left = each * (options.count - len(rows)) / 60
                mean = np.mean([row["scores"][OURS]["normal_mean"] for row in rows])
                print(
                    f"{len(rows)}/{options.count}  {each:.1f} s per picture, {left:.0f} min left; "
                    f"{OURS}: normals {mean:.2f}° on average",
                    file=sys.stderr, flush=True,
                )  # fmt: skip
    return rows


def _evaluate_range(options: EvaluationOptions, means: Means, numbers: range) -> Iterator[Row]:
    """Results in order, by one process per core if there are enough pictures."""
    workers = min(os.cpu_count() or 1, len(numbers) // _MIN_SHARE)
    if workers < 2:
        evaluator = PictureEvaluator(options, means)
        yield from map(evaluator.row, numbers)
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, spawn, initializer=_start_worker, initargs=(options, means)) as pool:
        yield from pool.map(_row, numbers)


_evaluator: "PictureEvaluator | None" = None  # of this worker


def _start_worker(options: EvaluationOptions, means: Means) -> None:
    global _evaluator
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    _evaluator = PictureEvaluator(options, means)


def _end_with_parent() -> None:
    """End this process when its parent ends, also after a crash of the parent."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _row(number: int) -> Row:
    assert _evaluator is not None
    return _evaluator.row(number)


def _read_results(path: Path, head: dict[str, Any]) -> list[Row]:
    """Results of an earlier run with the same inputs, without an unfinished last line."""
    lines = path.read_text().splitlines() if path.exists() else []
    if not lines or lines[0] != json.dumps(head):
        return []
    rows: list[Row] = []
    for line in lines[1:]:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


class PictureEvaluator:
    """Makes pictures and evaluates all estimators on them."""

    def __init__(self, options: EvaluationOptions, means: Means) -> None:
        self.made = Protocol(options.data, options.size, options.protocol)
        network = models.open_network(options.model, threads=1)
        found = {} if options.ablations is None else evaluation_baselines.find_checkpoints(options.ablations)
        self.columns: dict[str, Estimator] = {
            OURS: lambda case: _estimate(case.cues, network),
            CLEAN: lambda case: _estimate(case.clean, network),
            ANALYTIC: lambda case: _estimate(case.cues, None),
            "frontal": lambda case: evaluation_baselines.frontal(case.cues),
            "silhouette": lambda case: evaluation_baselines.inflated(case.cues),
            MEAN: lambda case: evaluation_baselines.constant(case.cues, means),
        } | {_network_alone(name): evaluation_baselines.network_alone(path) for name, path in found.items()}

    def row(self, number: int) -> Row:
        """Result of one picture: scores, seconds, sample of expected errors, moments of F0."""
        before = time.monotonic()
        case = self.made.case(number)
        seconds, scores, calibration = {"making the picture": time.monotonic() - before}, {}, []
        mask, judge, judging = case.truth.mask, Judge(case), 0.0
        for name, estimator in self.columns.items():
            before = time.monotonic()
            maps = estimator(case)
            seconds[name] = time.monotonic() - before
            before = time.monotonic()
            scores[name] = judge.score(maps) | (judge.integrated(maps) if name in _INTEGRATED else {})
            judging += time.monotonic() - before
            if name == OURS:
                some = np.random.default_rng(number).permutation(int(mask.sum()))[:_SAMPLE]
                calibration = [np.round(x[mask][some], 2).tolist() for x in (maps.confidence, angle(maps, case))]
        f0 = case.truth.specular[mask].astype(np.float64)
        return {
            "picture": number, "name": case.name, "scores": scores, "seconds": seconds | {"scoring all": judging},
            "calibration": calibration,
            "f0": [float(f0.mean()), float((f0**2).mean())],
        }  # fmt: skip


def _summary(head: dict[str, Any], rows: list[Row], alone: list[str]) -> dict[str, Any]:
    names = list(rows[0]["scores"])
    mean = {name: _mean([row["scores"][name] for row in rows]) for name in names}
    f0, square = np.mean([row["f0"] for row in rows], axis=0)
    predicted, actual = (np.concatenate([row["calibration"][k] for row in rows]) for k in (0, 1))
    deviation = float(np.sqrt(square - f0**2))
    return {
        "conditions": head | {"f0_deviation": deviation},
        "table": {name: mean[name] for name in names if name not in map(_network_alone, alone)},
        "ablations": {name: mean[_network_alone(name)] for name in alone},
        "of_mean_maps": {name: mean[OURS][name] / mean[MEAN][name] for name in MAPS},
        "calibration": deciles(predicted, actual),
        "seconds": _mean([row["seconds"] for row in rows]),
        "pictures": [{"name": row["name"], "scores": row["scores"]} for row in rows],
    }


def _mean(rows: list[Score]) -> Score:
    """Mean of each figure over the rows that have it."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: float(np.mean([row[key] for row in rows if key in row])) for key in keys}
