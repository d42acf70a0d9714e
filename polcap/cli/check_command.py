"""`polcap check`: keep a capture or reshoot it."""

from typing import Annotated

import typer

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Angles, CaptureFolder, ConfigFile, Json
from polcap.errors import GateError


def check(
    context: typer.Context,
    capture: CaptureFolder,
    config: ConfigFile = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="A setting, such as gates.max_blur_px=2; repeatable."),
    ] = None,
    angles: Angles = None,
    chart: Annotated[
        str | None,
        typer.Option(metavar="X0,Y0,…|FILE", help="The same as for process: corners of the chart, or a profile."),
    ] = None,
    no_chart: Annotated[bool, typer.Option("--no-chart", help="The same as for process: there is no chart.")] = False,
    json: Json = False,
) -> None:
    """Judge a capture seconds after its last frame: keep or reshoot, and why. Writes nothing."""
    from concurrent.futures import ThreadPoolExecutor

    from polcap import config as settings
    from polcap.formats.capture import reader as captures
    from polcap.pipeline import check as checks

    chosen, request = settings.load(config, assignments or ()), options.chart_request(chart, no_chart)
    with ThreadPoolExecutor(1) as pool:  # networks are opened while photographs are read
        opening = pool.submit(checks.shipped_networks)
        found = captures.read(capture, options.angles_deg(angles))
        verdict = checks.inspect(found, chosen, request, opening.result)
    terminal.print_data(checks.shown(verdict) if json else checks.table(verdict))
    if not verdict.keep:
        raise typer.Exit(GateError.exit_code)
