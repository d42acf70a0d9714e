"""polcap asks no network and writes only where it should, by the system calls of all its processes.

Python's sockets are not enough to watch: onnxruntime is a C++ library and opens its own.
"""

import functools
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import ROOT, slow

WATCH_S = 10.0  # onnxruntime 1.32 looks up its host's address 9 s after it is loaded
MINUTE_S = 60.0  # of a process that has loaded it
HOMES = ("writable", "unset", "unwritable")
CALLS = "open,openat,openat2,creat,mkdir,mkdirat,mknod,mknodat,truncate,rename,renameat,renameat2"
CALLS += ",link,linkat,symlink,symlinkat,unlink,unlinkat,rmdir"
CALL = re.compile(r"^\d+ +(\w+)\((.*)")
PATH = re.compile(r'(?:(?:AT_FDCWD|\d+)<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')  # with the folder that it is relative to
NO_FILES = ("/dev/", "/proc/")  # devices, and the kernel's answers


class Trace(NamedTuple):
    """What the processes of one command asked of the system."""

    sockets: list[str]  # calls that concern another machine
    written: set[Path]  # files and folders that were made, changed or removed, or that were to be


def traced(command: list[str], log: Path) -> list[str]:
    """The command line that runs a command and logs its calls and those of its children."""
    return [
        "strace",
        "-f",
        "--seccomp-bpf",
        "-y",
        "-qq",
        "-s",
        "4096",
        "-e",
        f"trace=%network,{CALLS}",
        "-o",
        str(log),
        *command,
    ]


def read(log: Path, folder: Path) -> Trace:
    """The log of a command that ran in a folder."""
    sockets, written = [], set()
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        if not (found := CALL.match(line)):
            continue
        name, arguments = found.groups()
        if name not in CALLS.split(","):
            if "AF_" in arguments and "AF_UNIX" not in arguments:
                sockets.append(line)
        elif not name.startswith("open") or re.search(r"O_(WRONLY|RDWR|CREAT|TRUNC|TMPFILE)", arguments):
            for base, path in PATH.findall(arguments):
                written.add(Path(os.path.normpath(folder / base / path)))
    return Trace(sockets, {path for path in written if not str(path).startswith(NO_FILES)})


@functools.cache
def _cannot_trace() -> str:
    if not shutil.which("strace"):
        return "no strace"
    done = subprocess.run(traced(["true"], Path(os.devnull)), capture_output=True, text=True)
    return done.stderr.strip() if done.returncode else ""


@pytest.fixture(autouse=True)
def strace() -> None:
    if reason := _cannot_trace():
        pytest.skip(f"system calls cannot be followed: {reason}")


@pytest.fixture
def temporary() -> Iterator[Path]:
    """A temporary folder with a short name: a batch makes local sockets there, whose paths have 108 bytes at most."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.fixture
def environment(temporary: Path) -> dict[str, str]:
    """Of a user who has turned nothing off, without a home folder: the user database alone knows one."""
    usual = {name: value for name, value in os.environ.items() if name not in ("ORT_DISABLE_TELEMETRY", "HOME")}
    return usual | {"TMPDIR": str(temporary), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}


def run_polcap(arguments: list[str], folder: Path, environment: dict[str, str]) -> Trace:
    """System calls of a command that ends with a result, run in `folder`."""
    command = traced([sys.executable, "-m", "polcap", *arguments], folder / "log")
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 3), done.stderr
    return read(folder / "log", folder)


def outside(paths: set[Path], *folders: Path) -> list[Path]:
    """The paths that lie in none of the folders."""
    return sorted(path for path in paths if not any(path.is_relative_to(folder) for folder in folders))


def test_a_request_and_a_file_of_a_child_are_seen(tmp_path: Path, environment: dict[str, str]) -> None:
    """So that the tests below can fail."""
    ask = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('192.0.2.1', 53))"
    write = "import os; os.mkdir('made'); os.open('id', os.O_CREAT, dir_fd=os.open('made', os.O_RDONLY))"
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {f'{ask}; {write}'!r}], check=True)"
    command = traced([sys.executable, "-c", child], tmp_path / "log")
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, timeout=60)
    seen = read(tmp_path / "log", tmp_path)
    assert [line for line in seen.sockets if "192.0.2.1" in line] and {"made", "id"} == {p.name for p in seen.written}
    assert outside(seen.written, tmp_path / "other") == [tmp_path / "made", tmp_path / "made" / "id"]


def start_watching(capture: Path, folder: Path, home: str, environment: dict[str, str]) -> subprocess.Popen[str]:
    """`process --watch`, which also follows the settings file set.toml, with a kind of home folder."""
    if home == "writable":
        (folder / "home").mkdir()
    elif home == "unwritable":
        (folder / "home").touch()  # a file, so that nobody, root included, can write there
    if home != "unset":
        environment = environment | {"HOME": str(folder / "home")}
    (folder / "set.toml").touch()
    command = [sys.executable, "-m", "polcap", "process", str(capture), "--no-chart", "--out", "out", "--watch"]
    command += ["--config", "set.toml"]
    return subprocess.Popen(
        traced(command, folder / "log"),
        cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


Watching = dict[Path, subprocess.Popen[str]]


@pytest.fixture(params=[("writable",)])
def watching(
    request: pytest.FixtureRequest, tiny: Path, tmp_path: Path, environment: dict[str, str]
) -> Iterator[Watching]:
    """One process for each kind of home folder, all at the same time, by their folders."""
    running = {}
    for home in request.param:
        (folder := tmp_path / home).mkdir()
        running[folder] = start_watching(tiny / "C", folder, home, environment)
    yield running
    for process in running.values():
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def test_commands_ask_no_network_and_write_only_their_results(
    tiny: Path, tmp_path: Path, temporary: Path, environment: dict[str, str], watching: Watching
) -> None:
    """`process` and `batch` run while `process --watch` waits.

    The workers of a batch get a copy of their parent's environment, in which nothing has imported onnxruntime.
    """
    _read_until_watching(watching)
    end = time.monotonic() + WATCH_S
    (tmp_path / "file").touch()
    shutil.copytree(tiny / "C", tmp_path / "captures" / "C", ignore=shutil.ignore_patterns("polcap"))
    for command, source, home in (("process", tiny / "C", "file"), ("batch", tmp_path / "captures", "home")):
        out = tmp_path / command
        arguments = [command, str(source), "--no-chart", "--out", str(out)]
        _require_only_results(
            run_polcap(arguments, tmp_path, environment | {"HOME": str(tmp_path / home)}), out, temporary
        )
    time.sleep(max(0.0, end - time.monotonic()))
    _require_silence(watching, temporary)


@slow
@pytest.mark.parametrize("watching", [HOMES], indirect=True)
def test_a_minute_of_watch_asks_no_network_and_writes_only_its_result(temporary: Path, watching: Watching) -> None:
    _read_until_watching(watching)
    for folder in watching:
        (folder / "set.toml").write_text("[surface]\nback = 'skirt'\n")
    _read_until_watching(watching)
    time.sleep(MINUTE_S)
    _require_silence(watching, temporary)


def _require_only_results(seen: Trace, out: Path, temporary: Path) -> None:
    assert seen.sockets == []
    assert any(path.name == "report.json" for path in seen.written)
    assert outside(seen.written, out, temporary) == []


def _require_silence(watching: dict[Path, subprocess.Popen[str]], temporary: Path) -> None:
    """End the processes and check what they asked of the system."""
    for folder, process in watching.items():
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60) == 130
        _require_only_results(read(folder / "log", folder), folder / "out", temporary)


def _read_until_watching(watching: Watching) -> None:
    """Wait until every process has processed the capture."""
    for process in watching.values():
        assert process.stderr is not None
        while "watching" not in (line := process.stderr.readline()):
            assert line, "it ended before it had processed the capture"


def test_a_trial_of_a_foreign_model_writes_nothing(
    tmp_path: Path, temporary: Path, environment: dict[str, str]
) -> None:
    """It imports onnxruntime in a child process of its own."""
    shipped, model, log = ROOT / "calib" / "models" / "fine.onnx", tmp_path / "foreign.onnx", tmp_path / "log"
    metadata = b"\x0a\x04note\x12\x04copy"  # protobuf: key and value, appended to ModelProto.metadata_props
    model.write_bytes(shipped.read_bytes() + b"\x72" + bytes([len(metadata)]) + metadata)
    code = "import sys; from polcap.formats import onnx; from polcap.stages.infer import fine; "
    code += "onnx.load(sys.argv[1], encoding=fine.ENCODING)"
    environment["HOME"] = str(tmp_path)
    command = traced([sys.executable, "-c", code, str(model)], log)
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, timeout=60)
    calls = log.read_text(encoding="utf-8", errors="replace").splitlines()
    assert len({line.split()[0] for line in calls if "onnxruntime_pybind11_state" in line}) == 2  # processes
    seen = read(log, tmp_path)
    assert seen.sockets == [] and outside(seen.written, temporary) == []


def test_onnxruntime_is_imported_in_one_place() -> None:
    """Which turns its telemetry off before."""
    imports = {
        str(file.relative_to(ROOT)): found
        for file in (ROOT / "polcap").rglob("*.py")
        if (found := re.findall(r"^\s*(?:import|from) onnxruntime.*", file.read_text(encoding="utf-8"), re.MULTILINE))
    }
    assert imports == {"polcap/formats/onnx.py": ["    import onnxruntime"]}
