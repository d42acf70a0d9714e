"""`polcap doctor`: check this machine, or one photograph."""

import functools
import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option, confirm

from polcap import terminal
from polcap.cli.options import Json
from polcap.errors import SettingError


def doctor(
    ask_ports: Annotated[
        bool | None,
        Option("--ports/--no-ports", help="Write to the serial ports to find motors; by default you are asked."),
    ] = None,
    json: Json = False,
    file: Annotated[Path | None, Argument(metavar="[FILE.RAW]", help="One photograph: can polcap use it?")] = None,
) -> None:
    """Check this machine or one photograph, and name the remedy of every fault."""
    from polcap import doctor as doctors

    if file is not None:
        from polcap.doctor.photograph import examine_file

        findings = tuple(examine_file(file))
    else:
        from polcap.rig import camera_gphoto2, device_urls, serial_port

        may_write = functools.partial(_may_write, ask_ports)
        cameras = camera_gphoto2.connected_cameras
        rig = doctors.Rig(serial_port.serial_ports, may_write, device_urls.probe, cameras)
        findings = doctors.examine(rig, Path.cwd())
    terminal.print_data(doctors.to_json(findings) if json else doctors.table(findings))
    if any(finding.state == "fault" for finding in findings):
        raise Exit(SettingError.exit_code)


def _may_write(stated: bool | None, ports: list[str]) -> bool:
    """Whether `polcap doctor` may write to serial ports, by option or question.

    Other devices may misread a motor's command.
    """
    if stated is not None or not sys.stdin.isatty():
        return bool(stated)
    return confirm(f"Write to {', '.join(ports)} to find motors?", err=True)
