"""What holds on any system, shown on this one: no Unix module is needed, and nothing asks the network."""

import subprocess
import sys
from pathlib import Path

from tests.conftest import EXAMPLE, ROOT

IMPORTS = """
import importlib, pkgutil, sys
import filelock, serial, serial.tools.list_ports, subprocess, tempfile  # these choose by the system
for name in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[name] = None  # an import of it fails
import polcap
for module in pkgutil.walk_packages(polcap.__path__, "polcap."):
    if "training" not in module.name and not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            if error.name in ("fcntl", "resource", "termios", "pwd", "grp"):
                raise
print("imported")
"""

OFFLINE = """
import socket, sys
class Refused(Exception): ...
def refuse(*arguments, **options):
    raise Refused(f"the network was asked: {arguments}")
socket.socket.connect = socket.socket.connect_ex = socket.socket.sendto = refuse
socket.create_connection = socket.getaddrinfo = socket.gethostbyname = refuse
from polcap import cli
sys.argv = ["polcap", *sys.argv[1:]]
cli.main()
"""


def python(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500)


def test_every_module_imports_where_there_are_no_unix_modules() -> None:
    done = python(IMPORTS)
    assert done.stdout.strip().endswith("imported"), done.stderr


def test_nothing_at_run_time_asks_the_network(tmp_path: Path) -> None:
    done = python(OFFLINE, "process", EXAMPLE, "--out", tmp_path / "out", "--until", "stokes")
    assert done.returncode == 0 and "network was asked" not in done.stderr, done.stderr
    assert python(OFFLINE, "doctor", "--no-ports").returncode in (0, 2)
