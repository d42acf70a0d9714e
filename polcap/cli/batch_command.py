"""`polcap batch`: process every capture below a folder."""

import os
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Exit, Option

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.cli.options import Angles, Assignments, ConfigFile, Device, Estimator, Json, Model, NoChart


def batch(
    context: Context,
    root: Annotated[Path, Argument(help="Folder with captures, at any depth.")],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for the results; by default CAPTURE/polcap each.")
    ] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    shard: Annotated[
        str | None, Option(metavar="K/N", help="The K-th of N parts; by default from Slurm, AWS, Kubernetes or PBS.")
    ] = None,
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="A Dask scheduler, tcp://host:8786 or local (extra [batch]).")
    ] = None,
    workers: Annotated[int, Option("--workers", "-j", min=1, help="Captures at a time on this machine.")] = 1,
    retries: Annotated[int, Option(min=0, help="Further tries for a capture whose process died.")] = 2,
    keep_going: Annotated[
        bool, Option("--keep-going/--fail-fast", help="Go on after a failure, or stop at the first.")
    ] = True,
    json: Json = False,
    device: Device = "cpu",
    threads: options.ProcessThreads = 0,
    memory: options.ProcessMemory = 0,
    angles: Angles = None,
    chart: Annotated[Path | None, Option(metavar="FILE", help="Color profile for all captures.")] = None,
    no_chart: NoChart = False,
    estimator: Estimator = None,
    model: Model = None,
) -> None:
    """Process every capture below a folder. Finished ones are skipped; a failure does not stop the others."""
    from polcap import batch as batches
    from polcap import config as settings
    from polcap.batch import shards, unit
    from polcap.pipeline import models

    options.check_out(out)
    resource_limits.check_memory(memory)
    if model is not None or estimator == "network":  # refuse an unusable model before any capture is processed
        models.load_network(estimator, model, "cpu", 1)  # the GPU may be in other machines
    stated = {**context.params, "model": None if model is None else model.resolve()}
    request = options.request(stated, settings.load(config, assignments or ()))
    part = shards.from_environment(os.environ) if shard is None else shards.parse(shard)
    plan = batches.BatchPlan(part, scheduler, workers, retries, keep_going)
    summary = batches.run(root, out, request, plan, terminal.print_progress)
    terminal.print_data(summary if json else str((out or root) / unit.FOLDER / "summary.html"))
    if code := batches.exit_code(summary):
        raise Exit(code)
