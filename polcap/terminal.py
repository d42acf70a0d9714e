"""Output of the commands: data on stdout, messages and progress on stderr, exit codes."""

import functools
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from polcap import resource_limits
from polcap.errors import GateError, PolcapError, SettingError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


_LONGEST = 600  # characters of a message
_QUIET_S = 5.0  # between two lines about frames, where there is no terminal to write over


def reported(command: Callable[..., None]) -> Callable[..., None]:
    """Report a command's error in one line on stderr and by its exit code."""

    @functools.wraps(command)
    def run(context: typer.Context, *args: Any, **kwargs: Any) -> None:
        try:
            command(context, *args, **kwargs)
        except BrokenPipeError:  # the reader of stdout has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
        except KeyboardInterrupt:
            again = " with --resume" if kwargs.get("resume") is False else ""
            message = f"interrupted; run the same command again{again} to go on"
            print(f"polcap: {message}", file=sys.stderr)
            code = 130
            if not kwargs.get("watch"):  # Ctrl-C is its normal end
                print_error_document(kwargs, KeyboardInterrupt(message), code)
        except PolcapError as error:
            traceback_of(error, context)
            print_message(f"polcap: error: {line(error)}")
            code = error.exit_code
            print_error_document(kwargs, error, code)
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            traceback_of(error, context)
            if resource_limits.is_shortfall(error):
                print_message("polcap: error: out of memory; raise --memory or take a larger machine")
                code = SettingError.exit_code
                print_error_document(kwargs, error, code)
            elif isinstance(error, OSError):  # refused by the system: no bug
                name = f"{error.filename}: " if error.filename else ""
                print_message(
                    f"polcap: error: {name}{error.strerror or line(error)}; check the path and its permissions"
                )
                code = SettingError.exit_code
                print_error_document(kwargs, error, code)
            else:
                kind, how = type(error).__name__, "with the lines above" if context.obj else "run with --debug and"
                print_message(f"polcap: bug: {kind}: {line(error)}; {how} report it")
                code = 1
                print_error_document(kwargs, error, code)
        else:
            return
        raise typer.Exit(code)

    return run


def traceback_of(error: BaseException, context: typer.Context) -> None:
    """Print the traceback, with --debug."""
    if context.obj:
        import traceback

        print_message("".join(traceback.format_exception(error)).rstrip())


def print_error_document(options: dict[str, Any], error: BaseException, code: int) -> None:
    """Print an error as JSON on stdout, with --json; a failed gate has printed its report already."""
    if options.get("json") and not isinstance(error, GateError):
        print_data({"error": {"kind": type(error).__name__, "says": line(error), "exit_code": code}})


def line(error: BaseException) -> str:
    """An error's text on one line of at most 600 characters."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 100]} … {text[-100:]}"


def printable(text: str) -> str:
    """Text without control characters: names of files and cameras may hold anything."""
    return "".join(c if c.isprintable() or c in "\n\t" or "\ud800" <= c <= "\udfff" else "\ufffd" for c in text)


def print_message(text: str) -> None:
    """Print a message on stderr."""
    print(printable(text), file=sys.stderr, flush=True)


def print_data(data: Any) -> None:
    """Print data on stdout: text as it is, anything else as one JSON document."""
    if not isinstance(data, str):
        import json

        data = json.dumps(data, ensure_ascii=False, indent=1)
    print(printable(data), flush=True)


def preview(drawn: "list[Path]") -> None:
    """Show pictures on a color terminal, two pixels per character, on stderr."""
    if not sys.stderr.isatty() or os.environ.get("TERM") in (None, "dumb"):
        return
    from rich.console import Console
    from rich.text import Text

    from polcap.formats.maps import png

    console = Console(stderr=True)
    for file in drawn:
        if file.suffix != ".png":
            continue
        picture = png.fitted(png.read(file), console.width)
        for upper, lower in zip(picture[::2], picture[1::2], strict=True):
            line_ = Text(no_wrap=True)
            for above, below in zip(upper.tolist(), lower.tolist(), strict=True):
                line_.append("▀", f"rgb({above[0]},{above[1]},{above[2]}) on rgb({below[0]},{below[1]},{below[2]})")
            console.print(line_)


def print_result(about: dict[str, Any], out: "Path", json: bool) -> None:
    """Print the asset's path or the report, and the verdict. Raises GateError where a gate failed."""
    print_data(about if json else str(out / "asset" / f"{about['capture']['name']}.glb"))
    print_message(f"verdict {about['verdict']}; {out / 'report.html'}")
    print_gates(about)


def print_gates(about: dict[str, Any]) -> None:
    """Print failed gates and warnings. Raises GateError where a gate failed."""
    failed = 0
    for gate in about["gates"]:
        if gate["state"] in ("fail", "warn"):
            word = "gate failed" if gate["state"] == "fail" else "warning"
            cost = f", costs about {gate['cost_deg']:.0f}°" if gate["cost_deg"] >= 1 else ""
            print_message(f"polcap: {word}: {gate['name']}: {gate['says']}{cost}. {gate['remedy']}.")
            failed += gate["state"] == "fail"
    if failed:
        raise GateError(f"{failed} of {len(about['gates'])} gates failed; the asset was written, see report.html")


class Steps:
    """Progress without a terminal: a line per finished stage, and one per five seconds of frames."""

    def __init__(self) -> None:
        self._begun = self._last = time.monotonic()

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """A stage begins (no seconds) or has ended."""
        if seconds is not None:
            print(f"{name:14}{'cached' if cached else f'{seconds:.2f} s'}", file=sys.stderr, flush=True)

    def frame(self, done: int, total: int) -> None:
        """Report that `done` of `total` photographs are done."""
        now = time.monotonic()
        if now - self._last > _QUIET_S:
            self._last = now
            print(f"{done} of {total} frames, {self._left(done, total, now)} left", file=sys.stderr, flush=True)

    def _left(self, done: int, total: int, now: float) -> str:
        seconds = (now - self._begun) / done * (total - done)
        return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


class Bar(Steps):
    """Progress on a terminal: one bar."""

    def __init__(self, bar: "RichProgress", task: "TaskID") -> None:
        super().__init__()
        self._bar, self._task = bar, task

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """A stage begins (no seconds) or has ended."""
        self._bar.update(self._task, description=name, advance=0 if seconds is None else 1)

    def frame(self, done: int, total: int) -> None:
        """Report that `done` of `total` photographs are done."""
        left = self._left(done, total, time.monotonic())
        self._bar.update(self._task, description=f"{done} of {total} frames, {left} left")


@contextmanager
def progress(total: int) -> Iterator[Steps]:
    """A bar on a terminal, else a line per finished stage."""
    if not sys.stderr.isatty():
        yield Steps()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:28}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield Bar(bar, bar.add_task("", total=total))
