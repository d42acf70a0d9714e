"""`polcap capture`: shoot a capture with a motorized polarizer and a camera."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Exit, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Json
from polcap.errors import GateError, InputError

if TYPE_CHECKING:
    from polcap.rig.shooting_plan import CaptureOrder
    from polcap.rig.turntable import SessionFile


def capture(
    folder: Annotated[Path, Argument(help="Folder for the photographs: a new one, or with --resume a begun one.")],
    rotator: Annotated[
        str | None, Option(metavar="URL", help="elliptec:PORT, grbl:PORT, line:PORT, manual or simulated.")
    ] = None,
    camera: Annotated[
        str | None, Option(metavar="NAME", help="gphoto2, gphoto2:MODEL, folder:PATH or simulated.")
    ] = None,
    angles: Annotated[str | None, Option(metavar="DEG,…", help="By default 0,45,90.")] = None,
    bracket: Annotated[
        str | None, Option(metavar="1/200,1/50,…", help="Exposures; also as f/11, iso100, flash1/16.")
    ] = None,
    repeat: Annotated[
        str | None,
        Option(metavar="DEG,…", help="Angles whose bracket is taken twice, to measure the spread of the flash."),
    ] = None,
    ambient: Annotated[bool, Option("--ambient", help="Also frames without the flash.")] = False,
    chart: Annotated[bool, Option("--chart", help="Also a frame of the chart alone.")] = False,
    cross: Annotated[bool, Option("--cross", help="Also a bracket under a cross-polarized flash.")] = False,
    views: Annotated[
        int | None, Option(min=3, max=99, metavar="N", help="N captures from all sides, in view01, view02, …")
    ] = None,
    turntable: Annotated[
        str | None, Option(metavar="URL", help="Turns the object between the views; as --rotator.")
    ] = None,
    tries: Annotated[int, Option(min=0, help="How often a bad frame is taken again.")] = 2,
    resume: Annotated[bool, Option("--resume", help="Go on with a stopped capture.")] = False,
    no_check: Annotated[bool, Option("--no-check", help="Leave out the verdict at the end.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", "-n", help="Print the plan with its times, and stop.")] = False,
    json: Json = False,
) -> None:
    """Shoot a capture: turn the polarizer, take the brackets, check every frame."""
    from polcap.rig import dry_run as plans
    from polcap.rig import exposure_bracket
    from polcap.rig import turntable as tables
    from polcap.rig.resume import complete_order

    stated = {
        "rotator": rotator,
        "camera": camera,
        "angles_deg": options.angles_deg(angles),
        "bracket": None if bracket is None else exposure_bracket.parse_bracket(bracket),
        "repeat_deg": None if repeat is None else options.numbers("--repeat", repeat, "write 45 or 0,90"),
        "ambient": ambient or None,
        "chart": chart or None,
        "cross": cross or None,
    }
    session = tables.open_session(folder, views, turntable, resume)
    wanted = complete_order(tables.first_view(folder) if session else folder, stated, resume)
    if dry_run:
        planned = plans.dry_run(wanted)
        terminal.print_data(planned if json else plans.table(planned))
        return
    summary, verdicts = _shoot(folder, session, wanted, resume=resume, tries=tries, judged=not no_check)
    terminal.print_data(summary if json else str(folder))
    if any(verdict and verdict["verdict"] != "keep" for verdict in verdicts):
        raise Exit(GateError.exit_code)


def _shoot(
    folder: Path, session: "SessionFile | None", wanted: "CaptureOrder", *, resume: bool, tries: int, judged: bool
) -> tuple[dict[str, Any], list[dict[str, Any] | None]]:
    """Shoot one capture, or the views of a session; returns the summary for --json, and the verdict of each capture.

    Each view is judged before the object turns. Without `judged`, all verdicts are None.
    """
    from polcap.rig import sequence
    from polcap.rig import turntable as tables

    report, verdicts = terminal.print_progress, dict[str, dict[str, Any] | None]()  # by the name of the folder

    def judge(finished: Path) -> None:
        verdicts[finished.name] = _verdict(finished) if judged else None

    if session is None:
        summary = sequence.shoot(folder, wanted, resume=resume, tries=tries, report=report)
        judge(folder)
        return {**summary, "check": verdicts[folder.name]}, list(verdicts.values())
    views = tables.shoot(folder, session, wanted, tries=tries, report=report, finished=judge)
    return {"folder": str(folder), "views": views, "check": verdicts}, list(verdicts.values())


def _verdict(folder: Path) -> dict[str, Any] | None:
    """Judge the finished capture as `polcap check` does, and print the verdict; None if it cannot be judged."""
    from polcap.config import Config
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import check as checks

    try:
        verdict = checks.inspect(captures.read(folder), Config())
    except InputError as error:
        terminal.print_message(f"polcap: not judged: {terminal.line(error)}")
        return None
    terminal.print_progress(checks.table(verdict))
    return checks.to_json(verdict)
