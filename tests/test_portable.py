"""What holds on any system, shown on this one: no Unix module is needed, and nothing asks the network."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tests.conftest import EXAMPLE, ROOT, Command

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
from polcap.cli import main
given = sys.argv[1:]
chart = ["process", *given, "--until", "whitebalance"]
for words in (chart, ["process", *given, "--no-chart"], ["doctor", "--no-ports"]):
    sys.argv[1:] = words
    try:
        main()
    except SystemExit as end:
        print("exit", end.code)
"""


def python(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500)


def test_every_module_imports_where_there_are_no_unix_modules() -> None:
    done = python(IMPORTS)
    assert done.stdout.strip().endswith("imported"), done.stderr


def test_nothing_at_run_time_asks_the_network(tiny: Path, tmp_path: Path) -> None:
    done = python(OFFLINE, tiny / "C", "--out", tmp_path / "out")
    assert re.findall(r"^exit (\d)$", done.stdout, re.M)[:2] == ["2", "3"], done.stderr  # no chart; a gate failed
    assert "network was asked" not in done.stderr


def test_path_of_500_characters_is_read_and_written(tmp_path: Path, polcap: Command) -> None:
    """Every part under 256, as file systems have it; the capture's own name is as long as it may be."""
    capture = tmp_path / ("d" * 150) / ("e" * 150) / ("n" * 250)
    shutil.copytree(EXAMPLE, capture, ignore=shutil.ignore_patterns("polcap"))
    done = polcap("process", capture, "--until", "hdr", "--estimator", "analytic")
    assert done.returncode == 0, done.stderr
    assert polcap("status", capture / "polcap").stdout.startswith("hdr ")


def test_what_is_written_below_a_result_is_short_however_long_the_captures_name(
    result: Path, tmp_path: Path, polcap: Command
) -> None:
    """So that the 260 characters of Windows are left to the folder; the reference page states the number."""
    copy = tmp_path / "copy"
    shutil.copytree(result, copy, ignore=shutil.ignore_patterns("work"))
    about = json.loads((copy / "report.json").read_text())
    about["capture"]["name"] = "n" * 250
    (copy / "report.json").write_text(json.dumps(about))
    done = polcap("export", copy, "--gltf", "--obj", "--materialx", "--exr")
    assert done.returncode == 0, done.stderr
    longest = max(len(str(file.relative_to(copy))) for file in copy.rglob("*"))
    page = (ROOT / "docs" / "reference" / "result.md").read_text(encoding="utf-8")
    assert longest + len("archive/") + len(".4194304-0123abcd.part") <= 120 and "120 characters" in page
