"""In: a capture folder and options. Out: its maps, asset and verdict, once or at every change: `polcap process`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.cli.options import Angles, Assignments, ConfigFile, Device, Estimator, Json, Model, NoChart
from polcap.errors import GateError, InputError, SettingError

if TYPE_CHECKING:
    from concurrent.futures import Future

    from polcap.config import Config
    from polcap.formats.raw.probed import Probed
    from polcap.images import Capture, ChartRequest
    from polcap.pipeline.path import UserInput
    from polcap.pipeline.unchanged import Finished


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
    from concurrent.futures import ThreadPoolExecutor

    from polcap.pipeline import unchanged

    target = out or capture / "polcap"
    request = None if until or force or dry_run or watch else _request(context.params, capture, target)
    if (finished := unchanged.find(target, request)) is not None:
        _tell_finished(finished, target, json)
        return
    resource_limits.set_threads(threads)  # before the libraries that start them
    if not memory:
        resource_limits.keep_pages()
    beside = ThreadPoolExecutor(2)
    look = cache(partial(_look, target, force is not None))
    # in the child, or from memory, while all else is imported
    first = beside.submit(_understood, capture, options.angles_deg(angles), look)
    with resource_limits.no_garbage():
        from polcap.parallel import Once

        asked = options.chart_request(chart, no_chart)
        user_input = Once(partial(_user_input, asked, mask, estimator, model, device, threads))
        if mask is None and model is None:  # what polcap ships is read meanwhile, too
            beside.submit(user_input)
        beside.shutdown(wait=False)
        from polcap import config as settings
        from polcap.pipeline import run as pipeline  # noqa: F401 — it is needed soon
        from polcap.pipeline.path import STAGES

    resource_limits.set_memory(memory)
    for flag, stage in (("--until", until), ("--force", force)):
        if stage is not None and stage not in STAGES:
            raise SettingError(f"{flag} {stage}: no such stage; choose one of {', '.join(STAGES)}")
    run = _Run(
        capture,
        target,
        options.angles_deg(angles),
        partial(settings.load, config, assignments or ()),
        user_input,
        until,
        force,
        json,
        request,
        look,
        [] if watch else [first],
    )
    if watch:
        run.settings()  # what is wrong with them now ends the command
        edited = [] if config is None else [config]
        _whenever_settled(capture, run.target, edited, run.plan if dry_run else run.process)
    elif dry_run:
        run.plan()
    else:
        run.process()


@dataclass(frozen=True)
class _Run:
    """What was asked for; --watch does it again and again."""

    folder: Path  # of the photographs
    target: Path
    angles_deg: tuple[float, ...] | None
    settings: "Callable[[], Config]"  # reads them anew
    user_input: "Callable[[], UserInput]"  # loads the networks, when it is first called
    until: str | None
    force: str | None
    json: bool
    request: str | None  # its digest, to know it again; None where it is always done
    look: "Callable[[], Probed]"  # opens what is remembered of the photographs, when it is first called
    begun: "list[Future[Capture]]"  # a reading of the photographs that is under way

    def plan(self) -> None:
        """Print what was understood and what would be computed."""
        from polcap import report
        from polcap.formats.capture import reader as captures
        from polcap.pipeline import run as pipeline

        config, found = self.settings(), self.understood()
        stages = pipeline.plan(found, self.user_input(), config, self.target, self.force)
        if self.json:
            terminal.say({"capture": report.capture_facts(found), "stages": stages})
        else:
            rows = (f"{name:14}{state}" for name, state in stages.items())
            terminal.say("\n".join([captures.table(found), "", *rows]))

    def understood(self) -> "Capture":
        """The photographs as they are now."""
        return self.begun.pop().result() if self.begun else _understood(self.folder, self.angles_deg, self.look)

    def process(self) -> None:
        """Write the result folder; say where, and what its gates judge."""
        from polcap.formats.capture import reader as captures
        from polcap.pipeline import run as pipeline
        from polcap.pipeline import unchanged
        from polcap.pipeline.path import STAGES

        config, supplied = self.settings(), self.user_input()
        found = self.understood()
        table = captures.table(found)
        terminal.tell(table)
        with terminal.progress(len(STAGES) + 1) as bar:
            about = pipeline.process(found, supplied, config, self.target, self.until, self.force, bar.stage, bar.frame)
        self.look().remember()
        if about is None:
            work = str(self.target / "work")
            terminal.say({"until": self.until, "work": work} if self.json else work)
            return
        unchanged.remember(self.target, self.request, table, (*pipeline.timings(self.target), "write"))
        _tell_result(about, self.target, self.json)


def _look(target: Path, anew: bool) -> "Probed":
    from polcap.formats.raw.probed import Probed
    from polcap.pipeline import unchanged

    program = None if anew else unchanged.known_program()
    return Probed() if program is None else Probed(target / "work" / "photographs.json", program)


def _understood(folder: Path, angles_deg: tuple[float, ...] | None, look: "Callable[[], Probed]") -> "Capture":
    from polcap.formats.capture import reader as captures

    return captures.read(folder, angles_deg, look())


def _user_input(
    chart: "ChartRequest",
    mask: Path | None,
    estimator: Literal["network", "analytic"] | None,
    model: Path | None,
    device: Literal["cpu", "cuda", "auto"],
    threads: int,
) -> "UserInput":
    from polcap.pipeline import models
    from polcap.pipeline.path import UserInput

    return UserInput(
        chart=chart,
        mask=None if mask is None else options.user_mask(mask),
        network=models.load_network(estimator, model, device, threads, later=True),
        mask_network=models.load_mask_network(threads, later=True),
    )


def _request(given: dict[str, Any], capture: Path, out: Path) -> str | None:
    """What identifies a run: its options and the state of all files that it reads."""
    from polcap.formats import calibrations
    from polcap.pipeline import unchanged

    aside = ("capture", "out", "json", "dry_run", "watch", "threads", "memory")  # they change no byte of a result
    files = [given[name] for name in ("config", "mask", "model") if given[name] is not None]
    if given["chart"] is not None and Path(given["chart"]).suffix == ".toml":
        files.append(Path(given["chart"]))
    files += calibrations.files()  # another one may be chosen
    asked = {name: value for name, value in given.items() if name not in aside}
    return unchanged.fingerprint(asked, capture, out, files)


def _tell_finished(finished: "Finished", out: Path, json: bool) -> None:
    """An earlier run's answer, as that run gave it."""
    terminal.tell(finished.table)
    with terminal.progress(len(finished.stages)) as bar:
        for name in finished.stages:
            bar.stage(name, 0.0, True)
    _tell_result(finished.report, out, json)


def _tell_result(about: dict[str, Any], out: Path, json: bool) -> None:
    """The asset on stdout, the verdict beside it; a failed gate ends with exit code 3."""
    terminal.say(about if json else str(out / "asset" / f"{about['capture']['name']}.glb"))
    terminal.tell(f"verdict {about['verdict']}; {out / 'report.html'}")
    terminal.tell_gates(about)


def _whenever_settled(capture: Path, target: Path, edited: Sequence[Path], once: Callable[[], None]) -> None:
    """Process a folder as it is and after each change of it or of the `edited` files.

    What is wrong with it is said, and it is looked at further.
    """
    from polcap.formats.capture import arrivals

    if not capture.is_dir():
        raise SettingError(f"{capture} is no folder; --watch needs the one that the photographs go to")
    for _ in arrivals.settled(capture, target, edited=edited):
        try:
            once()
        except (InputError, GateError, OSError) as error:  # a frame may have gone between two looks
            terminal.tell(f"polcap: {terminal.line(error)}")
        terminal.tell(f"watching {capture}; Ctrl-C ends")
