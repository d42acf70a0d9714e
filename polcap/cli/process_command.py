"""`polcap process`: a capture folder and options in; maps, asset and verdict out, once or at every change."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.cli.options import Angles, Assignments, ConfigFile, Device, Estimator, Json, Model, NoChart
from polcap.errors import GateError, InputError, SettingError

_NO_EFFECT = ("capture", "out", "json", "dry_run", "watch", "threads", "memory")  # on the bytes of a result


def process(
    context: typer.Context,
    capture: Annotated[Path, typer.Argument(help="Folder with the photographs.")],
    out: Annotated[Path | None, typer.Option(help="Result folder; by default CAPTURE/polcap.")] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    until: Annotated[str | None, typer.Option(metavar="STAGE", help="Stop after this stage.")] = None,
    force: Annotated[
        str | None, typer.Option(metavar="STAGE", help="Compute this stage and all after it again.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what was understood, and stop.")] = False,
    watch: Annotated[
        bool,
        typer.Option("--watch", help="Stay: process again whenever the folder or --config has changed; Ctrl-C ends."),
    ] = False,
    json: Json = False,
    device: Device = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="Threads to use; 0 is all.")] = 0,
    memory: Annotated[float, typer.Option(min=0, help="Most memory to take, GB; 0 is no limit.")] = 0,
    angles: Angles = None,
    chart: Annotated[
        str | None,
        typer.Option(metavar="X0,Y0,…|FILE", help="Chart corners in RAW px, dark skin first, clockwise; or a profile."),
    ] = None,
    no_chart: NoChart = False,
    mask: Annotated[Path | None, typer.Option(metavar="PNG", help="White where the object is.")] = None,
    estimator: Estimator = None,
    model: Model = None,
) -> None:
    """Turn a capture into maps and a 3-D asset."""
    from polcap.pipeline import unchanged

    given = context.params
    target = out or capture / "polcap"
    request = None if until or force or dry_run or watch else _request(given, target)
    if (finished := unchanged.find(target, request)) is not None:
        terminal.tell(f"{finished.table}\nnothing has changed since the last run")
        _tell_result(finished.report, target, json)
        return
    resource_limits.set_threads(threads)  # before the libraries that start them
    resource_limits.set_memory(memory)
    from polcap.pipeline.path import STAGES

    for flag, stage in (("--until", until), ("--force", force)):
        if stage is not None and stage not in STAGES:
            raise SettingError(f"{flag} {stage}: no such stage; choose one of {', '.join(STAGES)}")
    once = partial(_plan, given, target) if dry_run else partial(_process, given, target, request)
    if watch:
        _whenever_settled(capture, target, config, once)
    else:
        once()


def _request(given: dict[str, Any], target: Path) -> str | None:
    """Digest of the options and of all files that the run would read; None where it has to run in any case."""
    from polcap.pipeline import unchanged

    asked = {name: value for name, value in given.items() if name not in _NO_EFFECT}
    files = [given[name] for name in ("config", "mask", "model") if given[name] is not None]
    if given["chart"] is not None and Path(given["chart"]).suffix == ".toml":
        files.append(Path(given["chart"]))
    return unchanged.request(asked, given["capture"], target, files)


def _inputs(given: dict[str, Any]) -> tuple[Any, Any, Any]:
    """The capture, the user's other inputs and the settings. Models are opened while photographs are read."""
    from concurrent.futures import ThreadPoolExecutor

    from polcap import config as settings
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import models
    from polcap.pipeline.path import UserInput

    config = settings.load(given["config"], given["assignments"] or ())
    chart = options.chart_request(given["chart"], given["no_chart"])
    mask = None if given["mask"] is None else options.user_mask(given["mask"])
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(captures.read, given["capture"], options.angles_deg(given["angles"]))
        network = models.load_network(given["estimator"], given["model"], given["device"], given["threads"])
        supplied = UserInput(chart, mask, network, models.load_mask_network(given["threads"]))
        return reading.result(), supplied, config


def _plan(given: dict[str, Any], target: Path) -> None:
    """Print what was understood and what would be computed."""
    from polcap import report
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import run as pipeline

    capture, supplied, config = _inputs(given)
    stages = pipeline.plan(capture, supplied, config, target, given["force"])
    rows = (f"{name:14}{state}" for name, state in stages.items())
    if given["json"]:
        terminal.say({"capture": report.capture_facts(capture), "stages": stages})
    else:
        terminal.say("\n".join([captures.table(capture), "", *rows]))


def _process(given: dict[str, Any], target: Path, request: str | None) -> None:
    """Write the result folder; print the path of the asset and the verdict."""
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import run as pipeline
    from polcap.pipeline import unchanged
    from polcap.pipeline.path import STAGES

    capture, supplied, config = _inputs(given)
    table = captures.table(capture)
    terminal.tell(table)
    with terminal.progress(len(STAGES) + 1) as bar:
        decode = pipeline.counted(capture, bar.frame)
        about = pipeline.process(capture, supplied, config, target, given["until"], given["force"], bar.stage, decode)
    if about is None:
        work = str(target / "work")
        terminal.say({"until": given["until"], "work": work} if given["json"] else work)
        return
    unchanged.remember(target, request, table)
    _tell_result(about, target, given["json"])


def _tell_result(about: dict[str, Any], out: Path, json: bool) -> None:
    """The asset on stdout, the verdict beside it; a failed gate ends with exit code 3."""
    terminal.say(about if json else str(out / "asset" / f"{about['capture']['name']}.glb"))
    terminal.tell(f"verdict {about['verdict']}; {out / 'report.html'}")
    terminal.tell_gates(about)


def _whenever_settled(capture: Path, target: Path, config: Path | None, once: Callable[[], None]) -> None:
    """Process a folder as it is, and after each change of it or of the settings' file; errors are told."""
    from polcap import config as settings
    from polcap.formats.capture import arrivals

    if not capture.is_dir():
        raise SettingError(f"{capture} is no folder; --watch needs the one that the photographs go to")
    settings.load(config, ())  # what is wrong with it now ends the command
    for _ in arrivals.settled(capture, target, edited=[] if config is None else [config]):
        try:
            once()
        except (InputError, GateError, OSError) as error:  # a frame may have gone between two looks
            terminal.tell(f"polcap: {terminal.line(error)}")
        terminal.tell(f"watching {capture}; Ctrl-C ends")
