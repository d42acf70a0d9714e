"""Ablation study, `polcap train --ablation`: trains every variant of the network alike, then evaluates all.

References
----------
Deschaintre, Lin & Ghosh, CVPR 2021, table 2; the evaluation's page has its figures next to ours.
"""

import time
from dataclasses import replace
from pathlib import Path

from polcap.errors import InputError
from polcap.training import evaluate, evaluation_protocol, train
from polcap.training.progress import Report, silent
from polcap.training.train import TrainingOptions
from polcap.training.variants import VARIANTS


def main(
    options: TrainingOptions,
    report: Report = silent,
    count: int = evaluation_protocol.QUICK_COUNT,
    size: int = evaluation_protocol.QUICK_SIZE,
) -> Path:
    """Train each variant into out/NAME on the same traced views, evaluate all on `count` pictures of `size` px.

    Returns the page out/evaluation.md. The first line of the report states the cost.

    Raises InputError: as in `train.main`; or the options choose a variant or a model to start with.
    """
    if options.variant != "ours" or options.start:
        raise InputError("--ablation trains all variants from random weights; leave out --variant and --start")
    evaluation_protocol.Protocol(options.data, size)  # unusable test data end the run before its hours
    report(_cost(options, count, size))
    began = time.monotonic()
    for number, name in enumerate(VARIANTS, 1):
        out = options.out / name
        resume = options.resume and (out / "last.pt").exists()
        train.main(
            replace(options, variant=name, out=out, resume=resume, traced=options.out),
            lambda text, name=name, number=number: report(f"{number}/{len(VARIANTS)} {name}: {text}"),  # type: ignore[misc]
        )
    trained = time.monotonic()
    model = options.out / "ours" / "model.onnx"
    evaluate.main(evaluate.EvaluationOptions(model, options.data, options.out, options.out, count, size), report)
    spent = f"training {(trained - began) / 60:.0f} min, evaluation {(time.monotonic() - trained) / 60:.0f} min"
    report(f"{spent}; {options.out / 'evaluation.md'}")
    return options.out / "evaluation.md"


def _cost(options: TrainingOptions, count: int, size: int) -> str:
    """A sentence on the computing time of an ablation study."""
    networks = len(VARIANTS)
    each = f"{options.minutes:g} min" if options.samples is None else f"{options.samples} pictures"
    total = f", {networks * options.minutes / 60:.1f} h in all" if options.samples is None else ""
    return (
        f"{networks} networks of {each} each{total}; further time goes to tracing the views, and to evaluating on "
        f"{count} pictures of {size}² px"
    )
