"""`polcap doctor`: check this machine, or one photograph."""

import functools
import sys
from pathlib import Path
from typing import Annotated

import typer

from polcap import terminal
from polcap.cli.options import Json
from polcap.errors import SettingError


def doctor(
    context: typer.Context,
    ask_ports: Annotated[
        bool | None,
        typer.Option("--ports/--no-ports", help="Write to the serial ports to find motors; by default you are asked."),
    ] = None,
    json: Json = False,
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.RAW]", help="One photograph: can polcap use it?")
    ] = None,
) -> None:
    """Check this machine or one photograph, and name the remedy of every fault."""
    from polcap import doctor as doctors

    if file is not None:
        from polcap.doctor.photograph import examine_file

        findings = tuple(examine_file(file))
        terminal.print_data(doctors.shown(findings) if json else doctors.table(findings))
        if any(one.state == "fault" for one in findings):
            raise typer.Exit(SettingError.exit_code)
        return
    from polcap.rig import camera_gphoto2, device_urls, serial_port

    rig = doctors.Rig(
        serial_port.serial_ports,
        functools.partial(_may_write, ask_ports),
        device_urls.probe,
        camera_gphoto2.connected_cameras,
    )
    found = doctors.examine(rig, Path.cwd())
    terminal.print_data(doctors.shown(found) if json else doctors.table(found))
    if any(one.state == "fault" for one in found):
        raise typer.Exit(SettingError.exit_code)


def _may_write(stated: bool | None, ports: list[str]) -> bool:
    """Whether serial ports may be written to: other devices may misread a motor's command."""
    if stated is not None or not sys.stdin.isatty():
        return bool(stated)
    return typer.confirm(f"Write to {', '.join(ports)} to find motors?", err=True)
