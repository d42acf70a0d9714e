"""`polcap validate`: accuracy of the normals that this rig measures, from a capture of a ball."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Option

from polcap import terminal
from polcap.cli import options
from polcap.errors import SettingError
from polcap.formats import own_folders


def validate(
    context: Context,
    capture: Annotated[Path, Argument(help="Folder with the photographs of a ball, or its result folder.")],
    ball: Annotated[bool, Option("--ball", help="The object is a ball: its outline gives the true normals.")] = False,
    diameter: Annotated[
        float | None, Option(min=1, max=10000, metavar="MM", help="The ball's diameter, for lengths in mm.")
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Result folder; of a result, the folder for the page.")
    ] = None,
    config: options.ConfigFile = None,
    assignments: options.Assignments = None,
    angles: options.Angles = None,
    clockwise: options.Clockwise = False,
    chart: options.Chart = None,
    no_chart: options.NoChart = False,
    json: options.Json = False,
    open_: options.OpenPage = False,
) -> None:
    """Measure the error of the normals on a ball. Later reports of the same camera, lens and filter state it."""
    from datetime import UTC, datetime

    import msgspec

    from polcap import config as settings
    from polcap.calibrate import ball_page, ball_validation
    from polcap.formats import atomic, ball_accuracies
    from polcap.pipeline import result_folder
    from polcap.pipeline import run as pipeline
    from polcap.report import read

    if not ball:
        raise SettingError("polcap validate needs a known object; photograph a ball and add --ball")
    if (capture / "report.json").exists():
        options.check_out(out)
        result, place = capture, out or capture
    else:
        result = place = out or capture / own_folders.OUTPUT
        request = options.request(context.params, settings.load(config, assignments or ()))
        found, supplied = request.open(capture)
        about = pipeline.process_once(found, supplied, request.config, result)
        terminal.print_progress(f"verdict {about['verdict']}; {result / 'report.html'}")
    measured, about = ball_validation.measure(result, diameter), read(result)
    figures, facts, reason = measured.figures, about["capture"], _reason_against_record(about)
    texts = ball_validation.lines(figures)
    made = datetime.now(UTC).isoformat(timespec="seconds")
    with result_folder.opened(place):
        ball_page.write(place, facts["name"], measured, texts)
        atomic.write_json(place / "ball.json", figures)
    record = None if reason else ball_accuracies.write(ball_validation.accuracy(figures, facts, made))
    terminal.print_progress("\n".join(texts))
    for text in figures.warnings:
        terminal.print_message(f"polcap: warning: {text}", "WARNING")
    if reason:
        terminal.print_message(f"polcap: warning: later reports will not state this accuracy: {reason}", "WARNING")
    page = str(place / "ball.html")
    written = {"page": page, "record": None if record is None else str(record)}
    terminal.print_data({**msgspec.to_builtins(figures), **written} if json else page)
    if open_:
        terminal.open_page(place / "ball.html")


def _reason_against_record(about: dict[str, Any]) -> str:
    """Why the accuracy of a result does not hold for its rig; "": it does."""
    failed = [gate["name"] for gate in about["gates"] if gate["state"] == "fail"]
    if failed:
        return f"gates failed ({', '.join(failed)}); see report.html, and photograph the ball again"
    return "" if about["capture"]["camera"] else "the photographs name no camera"
