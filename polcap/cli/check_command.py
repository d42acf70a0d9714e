"""`polcap check`: keep a capture or reshoot it."""

import typer

from polcap import terminal
from polcap.cli import options
from polcap.errors import GateError


def check(
    capture: options.CaptureFolder,
    config: options.ConfigFile = None,
    assignments: options.Assignments = None,
    angles: options.Angles = None,
    clockwise: options.Clockwise = False,
    chart: options.Chart = None,
    no_chart: options.NoChart = False,
    json: options.Json = False,
) -> None:
    """Judge a capture seconds after its last frame: keep or reshoot, and why. Writes nothing."""
    from concurrent.futures import ThreadPoolExecutor

    from polcap import config as settings
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import check as checks
    from polcap.pipeline import models

    chosen, request = settings.load(config, assignments or ()), options.chart_request(chart, no_chart)
    with ThreadPoolExecutor(1) as pool:  # networks are opened while photographs are read
        opening = pool.submit(models.load_networks)
        found = captures.read(capture, options.angles_deg(angles), clockwise)
        verdict = checks.inspect(found, chosen, request, opening.result)
    for note in found.notes:
        if "--resume" in note:  # the capture is unfinished
            terminal.print_message(f"polcap: {note}")
    terminal.print_data(checks.to_json(verdict) if json else checks.table(verdict, terminal.is_verbose()))
    if not verdict.keep:
        raise typer.Exit(GateError.exit_code)
