"""In: this machine, or one photograph. Out: what works, what does not, the remedy: `polcap doctor`."""

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
        typer.Option("--ports/--no-ports", help="Write to the serial ports to learn who answers; else you are asked."),
    ] = None,
    json: Json = False,
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.RAW]", help="One photograph: can polcap use it, what does it tell?")
    ] = None,
) -> None:
    """What works on this machine, or with one photograph; what does not, and the remedy."""
    from polcap import doctor as doctors

    if file is not None:
        from polcap.doctor.photograph import examine_file

        findings = tuple(examine_file(file))
        terminal.say(doctors.shown(findings) if json else doctors.table(findings))
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
    terminal.say(doctors.shown(found) if json else doctors.table(found))
    if any(one.state == "fault" for one in found):
        raise typer.Exit(SettingError.exit_code)


def _may_write(said: bool | None, ports: list[str]) -> bool:
    """Whether serial ports may be written to: a command for a rotator may mean something else to another device."""
    if said is not None or not sys.stdin.isatty():
        return bool(said)
    return typer.confirm(f"write to {', '.join(ports)} to learn who answers?", err=True)
