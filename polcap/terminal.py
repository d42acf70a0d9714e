"""Output of the commands: data on stdout, messages and progress on stderr, exit codes."""

import errno
import functools
import io
import json
import os
import platform
import shlex
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, TextIO

import typer

from polcap import resource_limits
from polcap.errors import GateError, PolcapError, SettingError, one_line

if TYPE_CHECKING:
    from pathlib import Path

    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


_LONGEST = 600  # characters of a message
_FRAMES_S = 5.0  # between two lines about frames, where there is no terminal to write over
_verbosity = 0  # -1 with --quiet, 1 with --verbose
_debug = False  # with --debug
_log_file: TextIO | None = None  # with --log
_outputs: dict[str, "_Output"] = {}  # stdout and --log: the exit code states whether they are complete
_Level = Literal["INFO", "WARNING", "ERROR"]


class _Output(io.FileIO):
    """An output file. If it cannot be written, because the disk is full or a reader has ended, the work goes on."""

    fault = ""

    def write(self, data: Any, /) -> int:
        """Write bytes; after the first failure, everything is discarded."""
        try:
            written = 0
            while written < len(data):  # a signal may end a write early
                written += super().write(data[written:]) or 0
            return len(data)
        except OSError as error:
            if error.errno != errno.EPIPE:  # the reader wanted no more
                self.fault = error.strerror or str(error)
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return len(data)


def _text(output: _Output, encoding: str = "utf-8") -> TextIO:
    """Text stream of an output; characters that it cannot encode, as in some names of files, are escaped.

    It has no buffer: after Ctrl-C in a write, a buffer would write its text again.
    """
    return io.TextIOWrapper(output, encoding, errors="backslashreplace", line_buffering=True)


def open_streams() -> None:
    """Prepare stdin, stdout and stderr for the whole run: a closed or full stream stops no work.

    A closed stream becomes the null device: otherwise the next opened file would get its number, and would receive the
    output.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(null)
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, encoding="utf-8", closefd=False)
    for handle, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if sys.platform == "win32" and stream is not None and stream.isatty():  # a console is no file
            stream.reconfigure(errors="backslashreplace")
            continue
        output = _Output(handle, "w", closefd=False)
        setattr(sys, name, _text(output, "utf-8" if stream is None else stream.encoding))
        if name == "stdout":
            _outputs["standard output"] = output


def final_code(code: int) -> int:
    """Exit code of a command that ended with `code`; where output is incomplete, prints an error, and 2 replaces 0."""
    for name, output in _outputs.items():
        if output.fault:
            print_message(f"polcap: error: {name} is incomplete: {output.fault}; write it elsewhere", "ERROR")
            code = code or SettingError.exit_code
    return code


def set_verbosity(quiet: bool, verbose: bool, debug: bool) -> None:
    """Print no progress, or a line per frame and stage in place of a bar; with `debug`, tracebacks of errors."""
    global _verbosity, _debug
    _verbosity, _debug = -1 if quiet else int(verbose), debug


def is_verbose() -> bool:
    """Whether --verbose was given."""
    return _verbosity > 0


def open_log(file: "Path | None") -> None:
    """Open the file of --log: write command line and versions; messages are appended from now on. Raises OSError."""
    global _log_file
    _log_file = None
    _outputs.pop("--log", None)
    if file is not None:
        from polcap.formats.export import provenance

        if file.is_file() and not _is_log(file):
            raise FileExistsError(errno.EEXIST, "is there, and is no log of polcap")
        _outputs["--log"] = output = _Output(file, "a", opener=_open_at_once)
        _log_file = _text(output)
        log(f"polcap {shlex.join(sys.argv[1:])}")
        versions = {"Python": platform.python_version(), **provenance.versions()}
        log(f"{', '.join(map(' '.join, versions.items()))}; {platform.platform()}")


def _open_at_once(path: str, flags: int) -> int:
    """Open a file for --log; a named pipe without a reader is an OSError, not a wait."""
    handle = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    if hasattr(os, "O_NONBLOCK"):
        os.set_blocking(handle, True)
    return handle


def _is_log(file: "Path") -> bool:
    """Whether a file is empty, or begins with a message of `log`."""
    with file.open("rb") as stream:
        first = stream.readline(_LONGEST)
    return not first or b" INFO    polcap " in first


def log(text: str, level: _Level = "INFO") -> None:
    """Write a message to the file of --log, if there is one: time and level before each line."""
    if _log_file is not None:
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        print(*(f"{now} {level:7} {row}" for row in printable(text).splitlines()), sep="\n", file=_log_file, flush=True)


def reported(command: Callable[..., None]) -> Callable[..., None]:
    """Report a command's error in one line on stderr and by its exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            return
        except (typer.Exit, typer.Abort):
            raise
        except (Exception, KeyboardInterrupt) as error:
            if _debug and isinstance(error, Exception):
                print_message("".join(traceback.format_exception(error)).rstrip())
            text, code = _explain(error, kwargs.get("resume") is False)
            print_message(f"polcap: {text}", "ERROR")
            if code == 1 and not _debug:
                log("".join(traceback.format_exception(error)), "ERROR")
            if not (isinstance(error, KeyboardInterrupt) and kwargs.get("watch")):  # Ctrl-C is its normal end
                print_error_document(kwargs, error, text.removeprefix("error: "), code)
        raise typer.Exit(code)

    return run


def _explain(error: BaseException, resumable: bool) -> tuple[str, int]:
    """Message and exit code for an error of a command; `resumable`: it has an option --resume, which is not given."""
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted; run the same command again{' with --resume' if resumable else ''} to go on", 130
    if isinstance(error, PolcapError):
        return f"error: {line(error)}", error.exit_code
    if resource_limits.is_shortfall(error):
        return "error: out of memory; raise --memory or take a larger machine", SettingError.exit_code
    if isinstance(error, OSError):  # refused by the system: no bug
        name = f"{error.filename}: " if error.filename else ""
        reason = f"{name}{error.strerror or line(error)}; check the path and its permissions"
        return f"error: {reason}", SettingError.exit_code
    remedy = "with the lines above" if _debug else "run with --debug and"
    return f"bug: {type(error).__name__}: {line(error)}; {remedy} report it", 1


def print_error_document(options: dict[str, Any], error: BaseException, text: str, code: int) -> None:
    """Print an error as JSON on stdout, with --json; a failed gate has printed its report already."""
    if options.get("json") and not isinstance(error, GateError):
        print_data({"error": {"kind": type(error).__name__, "says": text, "exit_code": code}})


def line(error: BaseException) -> str:
    """Text of an error on one line; a long text is cut in the middle to about 600 characters."""
    text = one_line(error)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 100]} … {text[-100:]}"


def printable(text: str) -> str:
    """Text without control characters: names of files and cameras may hold anything."""
    return "".join(c if c.isprintable() or c in "\n\t" or "\ud800" <= c <= "\udfff" else "\ufffd" for c in text)


def print_message(text: str, level: _Level = "INFO") -> None:
    """Print a message on stderr."""
    print(printable(text), file=sys.stderr, flush=True)
    log(text, level)


def print_progress(text: str) -> None:
    """Print a message on stderr that --quiet suppresses."""
    if _verbosity >= 0:
        print_message(text)
    else:
        log(text)


def print_data(data: Any) -> None:
    """Print data on stdout: text as it is, anything else as one JSON document."""
    text = data if isinstance(data, str) else json.dumps(data, ensure_ascii=False, indent=1)
    print(printable(text), flush=True)


def print_written(files: "Sequence[Path]", json: bool) -> None:
    """Print the paths of the files that a command has written."""
    names = [str(file) for file in files]
    print_data({"written": names} if json else "\n".join(names))


def print_result(about: dict[str, Any], out: "Path", json: bool, open_: bool) -> None:
    """Print the asset's path or the report, and the verdict. Raises GateError where a gate failed."""
    asset = str(out / "asset" / f"{about['capture']['name']}.glb")
    outputs = {"asset": asset, "maps": str(out / "maps"), "report": str(out / "report.html")}
    print_data({**about, "outputs": outputs} if json else asset)
    error = about.get("expected_error_deg")
    expected = "" if error is None else f", expected error of the normals {error:.1f}°"
    ball = about["capture"].get("ball")
    measured = "" if ball is None else f", on your ball {ball['mean_deg']:.1f}°"
    print_progress(f"verdict {about['verdict']}{expected}{measured}; {outputs['report']}")
    if open_:
        open_page(out / "report.html")
    print_gates(about)


def open_page(file: "Path") -> None:
    """Open a page in the user's browser, but not in continuous integration (CI is set)."""
    import webbrowser

    if os.environ.get("CI") or not webbrowser.open(file.resolve().as_uri()):
        print_message(f"polcap: no browser was opened; open {file} yourself")


def print_gates(about: dict[str, Any]) -> None:
    """Print failed gates and warnings, those with a remedy first. Raises GateError where a gate failed."""
    words: dict[str, tuple[str, _Level]] = {"fail": ("gate failed", "ERROR"), "warn": ("warning", "WARNING")}
    for gate in sorted(about["gates"], key=lambda gate: (gate["state"] != "fail", not gate["remedy"])):
        if gate["state"] in words:
            word, level = words[gate["state"]]
            cost = f", costs about {gate['cost_deg']:.0f}°" if gate["cost_deg"] >= 1 else ""
            remedy = f" {gate['remedy']}." if gate["remedy"] else ""
            print_message(f"polcap: {word}: {gate['name']}: {gate['says']}{cost}.{remedy}", level)
    if failed := sum(gate["state"] == "fail" for gate in about["gates"]):
        raise GateError(f"{failed} of {len(about['gates'])} gates failed; the asset was written, see report.html")


class Steps:
    """Progress without a terminal: a line per finished stage, and for photographs one in 5 s; all with --verbose."""

    def __init__(self) -> None:
        self._begun = self._last = time.monotonic()

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """Report that a stage begins (no seconds) or has ended."""
        if seconds is not None:
            print_progress(self._stage_text(name, seconds, cached))

    def frame(self, done: int, total: int) -> None:
        """Report that `done` of `total` photographs are done."""
        now = time.monotonic()
        if now - self._last > _FRAMES_S or _verbosity > 0:
            self._last = now
            print_progress(self._frames_text(done, total, now))

    def _stage_text(self, name: str, seconds: float, cached: bool) -> str:
        return f"{name:13} {'cached' if cached else f'{seconds:.2f} s'}"

    def _frames_text(self, done: int, total: int, now: float) -> str:
        seconds = (now - self._begun) / done * (total - done)
        remaining = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"{done} of {total} frames, {remaining} left"


class Bar(Steps):
    """Progress on a terminal: one bar."""

    def __init__(self, bar: "RichProgress", task: "TaskID") -> None:
        super().__init__()
        self._bar, self._task = bar, task

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """Report that a stage begins (no seconds) or has ended."""
        self._bar.update(self._task, description=name, advance=0 if seconds is None else 1)
        if seconds is not None:
            log(self._stage_text(name, seconds, cached))

    def frame(self, done: int, total: int) -> None:
        """Report that `done` of `total` photographs are done."""
        self._bar.update(self._task, description=self._frames_text(done, total, time.monotonic()))


@contextmanager
def progress(total: int) -> Iterator[Steps]:
    """Progress display of a command: a bar on a terminal, else a line per finished stage."""
    if _verbosity or not sys.stderr.isatty():
        yield Steps()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:28}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield Bar(bar, bar.add_task("", total=total))
