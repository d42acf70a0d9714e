"""Fixtures of several tests: a small capture, the `polcap` command, and one finished run of the two."""

import os
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run in parallel; OpenBLAS reads it when NumPy is loaded
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # some tests import onnxruntime themselves

import numpy as np
import pytest
from filelock import FileLock

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in a shell's background job; interruption is tested
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "tests" / "capture"
TINY = ("--no-chart", "--estimator", "analytic")  # how the tiny capture is processed
slow = pytest.mark.skipif("POLCAP_SLOW" not in os.environ, reason="takes a minute or more: set POLCAP_SLOW")


def pytest_configure(config: pytest.Config) -> None:
    """With POLCAP_SKIPPED_TO=FILE, list the tests that this machine skips; another one runs them with `@FILE`."""
    if (file := os.environ.get("POLCAP_SKIPPED_TO")) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(SkippedList(Path(file)))


class SkippedList:
    """Collects skipped files and tests, without parameters, which may differ between machines."""

    def __init__(self, file: Path) -> None:
        self._file, self._names = file, set[str]()

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.skipped:
            self._names.add(report.nodeid.partition("[")[0])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.skipped:
            self._names.add(report.nodeid.partition("[")[0])

    def pytest_sessionfinish(self) -> None:
        self._file.write_text("".join(f"{name}\n" for name in sorted(self._names)), encoding="utf-8")


class Done(NamedTuple):
    """Exit code and output of a command."""

    returncode: int
    stdout: str
    stderr: str


Command = Callable[..., Done]


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that no other test draws from."""
    return np.random.default_rng(6)


@pytest.fixture(scope="session")
def example() -> Path:
    """A small capture; never written to."""
    return EXAMPLE


def environment() -> dict[str, str]:
    """Environment of a child process that imports this polcap."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def python(*arguments: object) -> Done:
    """`python …` in a process of its own."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=500)
    return Done(done.returncode, done.stdout, done.stderr)


def shell(*arguments: object) -> Done:
    """`polcap …` as a user's shell runs it, in a process of its own."""
    return python("-m", "polcap", *arguments)


@pytest.fixture
def polcap(capsys: pytest.CaptureFixture[str]) -> Command:
    """`polcap …` in this process, which saves the imports."""
    from polcap import cli

    def run(*arguments: object) -> Done:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.app([*map(str, arguments)])
        return Done(ended.value.code or 0, *capsys.readouterr())  # type: ignore[arg-type]

    return run


@pytest.fixture
def run_example(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Run a program of examples/ in this process; returns what it printed."""

    def run(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "examples" / name))
        return capsys.readouterr().out

    return run


def made_once(factory: pytest.TempPathFactory, worker: str, name: str, make: Callable[[Path], None]) -> Path:
    """The folder `name`, which the first worker that asks for it makes for all."""
    base = factory.getbasetemp()
    folder = (base if worker == "master" else base.parent) / name
    with FileLock(folder.with_suffix(".lock")):
        if not (made := folder.with_suffix(".made")).exists():
            make(folder)
            made.touch()
    return folder


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The result folder of the small capture with the analytic estimator; read only."""

    def make(folder: Path) -> None:
        done = shell("process", EXAMPLE, "--out", folder, "--estimator", "analytic")
        assert done.returncode == 0, done.stderr

    return made_once(tmp_path_factory, worker_id, "small-result", make)


@pytest.fixture
def copy(result: Path, tmp_path: Path) -> Path:
    """A copy of that result folder, to be changed."""
    return Path(shutil.copytree(result, tmp_path / "copy"))


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A folder with a capture of 96 × 96 px, C, and its result C/polcap of the options TINY; read only."""
    from tests.campaigns.users_files import make_template

    return made_once(tmp_path_factory, worker_id, "tiny", make_template)


@pytest.fixture
def tiny_result(tiny: Path, tmp_path: Path) -> Path:
    """A copy of that result folder, to be changed."""
    return Path(shutil.copytree(tiny / "C" / "polcap", tmp_path / "tiny"))
