"""`polcap material`: several views of a flat sample become one material."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Option

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.errors import SettingError
from polcap.formats import own_folders

if TYPE_CHECKING:
    from polcap.material.material_session import Region


def material(
    context: Context,
    folder: Annotated[Path, Argument(help="Folder with the captures view01, view02, … of a flat sample on the board.")],
    out: Annotated[Path | None, Option("--out", "-o", help="Result folder; by default FOLDER/material.")] = None,
    region: Annotated[
        str | None,
        Option(metavar="X0,Y0,X1,Y1", help="Part of the board, mm from its middle, y up; by default its black middle."),
    ] = None,
    texel: Annotated[
        float | None, Option(min=0.001, metavar="MM", help="Size of a texel; by default that of the camera's pixels.")
    ] = None,
    tile: Annotated[
        bool,
        Option(
            "--tile",
            help="Make the maps seamless; they lose a sixth of each side, up to a third where patterns repeat.",
        ),
    ] = False,
    config: options.ConfigFile = None,
    assignments: options.Assignments = None,
    json: options.Json = False,
    open_: options.OpenPage = False,
    workers: Annotated[int, Option("--workers", "-j", min=1, help="Views at a time, each in a process.")] = 1,
    threads: options.ProcessThreads = 0,
    memory: options.ProcessMemory = 0,
    angles: options.Angles = None,
    clockwise: options.Clockwise = False,
    chart: options.Chart = None,
    no_chart: options.NoChart = False,
) -> None:
    """Measure the material of a flat sample from several views. Run again, it goes on where it was stopped."""
    from polcap.pipeline import unchanged

    target = out or folder / own_folders.MATERIAL
    asked = options.request_digest({**context.params, "config": config}, folder, target)
    if options.print_finished(target, asked, json, open_):
        return
    from polcap import config as settings
    from polcap.fusion.session_views import SessionInput
    from polcap.material import material_run
    from polcap.material.material_path import MaterialConfig
    from polcap.pipeline import asset_export

    resource_limits.set_limits(threads, memory)
    chosen = settings.fill(MaterialConfig, settings.read(config), assignments or [])
    stated = {**context.params, "estimator": "analytic"}  # no network is needed up to the Stokes parameters
    request = options.request(stated, chosen.of_views)
    session_input = SessionInput(folder, chosen, request, workers)
    about = material_run.measure(
        session_input, target, _region(region), None if texel is None else texel / 1000, tile,
        terminal.print_progress, terminal.Steps().stage,
    )  # fmt: skip
    options.warn_of_outdated_exports(target, asset_export.sidecars(target))
    unchanged.remember(target, asked, files=request.files())
    terminal.print_result(about, target, json, open_)


def _region(text: str | None) -> "Region | None":
    """Parse --region, mm; returns metres."""
    if text is None:
        return None
    found = options.numbers("--region", text, "write -40,-40,40,40")
    if len(found) != 4:
        raise SettingError(f"--region {text}: {len(found)} numbers, 4 are needed; write -40,-40,40,40")
    left, lower, right, upper = (one / 1000 for one in found)
    if left >= right or lower >= upper:
        raise SettingError(f"--region {text}: x0 < x1 and y0 < y1 are needed; write -40,-40,40,40")
    return left, lower, right, upper
