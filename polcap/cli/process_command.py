"""`polcap process`: turn a capture folder into maps, asset and report."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Context, Option

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.errors import GateError, InputError, SettingError
from polcap.formats import own_folders
from polcap.results import STAGES


def process(
    context: Context,
    capture: options.CaptureFolder,
    out: Annotated[Path | None, Option("--out", "-o", help="Result folder; by default CAPTURE/polcap.")] = None,
    config: options.ConfigFile = None,
    assignments: options.Assignments = None,
    until: options.Until = None,
    force: options.Force = None,
    dry_run: Annotated[
        bool, Option("--dry-run", "-n", help="Print the understood capture and the stages, and stop.")
    ] = False,
    watch: Annotated[bool, Option("--watch", help="Process again after changes of the folder or --config.")] = False,
    json: options.Json = False,
    open_: options.OpenPage = False,
    device: options.Device = "cpu",
    threads: options.Threads = 0,
    memory: options.Memory = 0,
    angles: options.Angles = None,
    clockwise: options.Clockwise = False,
    chart: options.Chart = None,
    no_chart: options.NoChart = False,
    mask: Annotated[Path | None, Option(metavar="PNG", help="White where the object is.")] = None,
    estimator: options.Estimator = None,
    model: options.Model = None,
) -> None:
    """Turn a capture into maps and a 3-D asset."""
    from polcap.formats import own_files

    stated = {**context.params, "capture": capture, "config": config, "mask": mask, "model": model}  # paths, not text
    target = out or capture / own_folders.OUTPUT
    if mask is not None and own_files.wrote(target, mask):
        raise SettingError(f"--mask {mask} is part of the result that this run replaces; copy it elsewhere first")
    asked = None if until or force or dry_run or watch else options.request_digest(stated, capture, target)
    if options.print_finished(target, asked, json, open_):
        return
    resource_limits.set_limits(threads, memory)  # before the libraries start threads
    run_once = partial(_plan, stated, target) if dry_run else partial(_process, stated, target, asked)
    if watch:
        _at_every_change(capture, target, config, run_once)
    else:
        run_once()


def _at_every_change(capture: Path, target: Path, config: Path | None, run_once: Callable[[], None]) -> None:
    """Call `run_once` now and after each change of the capture folder or the settings file; print its errors.

    Raises SettingError if there is no such folder, or the settings are wrong from the start.
    """
    from polcap import config as settings
    from polcap.formats.capture import arrivals

    if not capture.is_dir():
        raise SettingError(f"{capture} is no folder; --watch needs the folder that the photographs go to")
    settings.load(config, ())
    for _ in arrivals.settled(capture, target, edited=[] if config is None else [config]):
        try:
            run_once()
        except (InputError, GateError, OSError) as error:  # a frame may have gone while it was read
            terminal.print_message(f"polcap: {terminal.line(error)}")
        terminal.print_progress(f"watching {capture}; Ctrl-C ends")


def _plan(stated: dict[str, Any], target: Path) -> None:
    """Option --dry-run: print how the capture is understood and which stages would run."""
    from polcap import config as settings
    from polcap import report
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import run as pipeline

    request = options.request(stated, settings.load(stated["config"], stated["assignments"] or ()))
    capture, supplied = request.open(stated["capture"])
    stages = pipeline.plan(capture, supplied, request.config, target, stated["force"])
    rows = [f"{name:14}{state}" for name, state in stages.items()]
    table = "\n".join([captures.table(capture), "", *rows])
    terminal.print_data({"capture": report.capture_facts(capture), "stages": stages} if stated["json"] else table)


def _process(stated: dict[str, Any], target: Path, asked: str | None) -> None:
    """Process the capture and write the result folder; print the path of the asset and the verdict."""
    from dataclasses import replace

    from polcap import config as settings
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import asset_export, unchanged
    from polcap.pipeline import run as pipeline

    request = options.request(stated, settings.load(stated["config"], stated["assignments"] or ()))
    capture, supplied = request.open(stated["capture"])
    table = captures.table(capture)
    terminal.print_progress(table)
    with terminal.progress(len(STAGES) + 1) as bar:
        supplied = replace(supplied, decode=pipeline.decode_with_progress(capture, bar.frame))
        about = pipeline.process(capture, supplied, request.config, target, stated["until"], stated["force"], bar.stage)
    if about is None:
        work = str(target / "work")
        terminal.print_data({"until": stated["until"], "work": work} if stated["json"] else work)
        return
    options.warn_of_outdated_exports(target, asset_export.sidecars(target))
    unchanged.remember(target, asked, table, request.files())
    terminal.print_result(about, target, stated["json"], stated["open_"])
