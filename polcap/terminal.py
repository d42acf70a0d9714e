"""In: what a command found, or what befell it. Out: data on stdout, all else on stderr, an exit code."""

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
    """Turn what a command raises into one line on stderr and an exit code."""

    @functools.wraps(command)
    def run(context: typer.Context, *args: Any, **kwargs: Any) -> None:
        try:
            command(context, *args, **kwargs)
        except BrokenPipeError:  # whoever read stdout has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
        except KeyboardInterrupt:
            again = " with --resume" if kwargs.get("resume") is False else ""
            says = f"interrupted; run the same command again{again} to go on"
            print(f"polcap: {says}", file=sys.stderr)
            code = 130
            if not kwargs.get("watch"):  # it ends like that; its reports stand on stdout
                tell_program(kwargs, KeyboardInterrupt(says), code)
        except PolcapError as error:
            traceback_of(error, context)
            tell(f"polcap: error: {line(error)}")
            code = error.exit_code
            tell_program(kwargs, error, code)
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            traceback_of(error, context)
            if resource_limits.is_shortfall(error):
                tell("polcap: error: out of memory; raise --memory or take a larger machine")
                code = SettingError.exit_code
                tell_program(kwargs, error, code)
            elif isinstance(error, OSError):  # what the system refuses is not of our making
                name = f"{error.filename}: " if error.filename else ""
                tell(f"polcap: error: {name}{error.strerror or line(error)}; check the path and its permissions")
                code = SettingError.exit_code
                tell_program(kwargs, error, code)
            else:
                kind, how = type(error).__name__, "with the lines above" if context.obj else "run with --debug and"
                tell(f"polcap: bug: {kind}: {line(error)}; {how} report it")
                code = 1
                tell_program(kwargs, error, code)
        else:
            return
        raise typer.Exit(code)

    return run


def traceback_of(error: BaseException, context: typer.Context) -> None:
    """With --debug, where an error came from; what is said of it and the exit code stay the same."""
    if context.obj:
        import traceback

        tell("".join(traceback.format_exception(error)).rstrip())


def tell_program(options: dict[str, Any], error: BaseException, code: int) -> None:
    """With --json, what befell a command as a document on stdout; a failed gate's report stands there already."""
    if options.get("json") and not isinstance(error, GateError):
        say({"error": {"kind": type(error).__name__, "says": line(error), "exit_code": code}})


def line(error: BaseException) -> str:
    """What an error says, on one line of bearable length."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 100]} … {text[-100:]}"


def printable(text: str) -> str:
    """Without what a terminal takes for a command: names of files and cameras may hold anything."""
    return "".join(c if c.isprintable() or c in "\n\t" or "\ud800" <= c <= "\udfff" else "\ufffd" for c in text)


def tell(text: str) -> None:
    """Progress and messages, on stderr."""
    print(printable(text), file=sys.stderr, flush=True)


def say(data: Any) -> None:
    """Data on stdout: printable text, all else as one JSON document."""
    if not isinstance(data, str):
        import json

        data = json.dumps(data, ensure_ascii=False, indent=1)
    print(printable(data), flush=True)


def preview(drawn: "list[Path]") -> None:
    """Pictures on a terminal that knows colors, two pixels a character; on stderr, for stdout carries data."""
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


def tell_result(about: dict[str, Any], out: "Path", json: bool) -> None:
    """The asset's path, or the report, on stdout; the verdict on stderr; a failed gate ends with exit code 3."""
    say(about if json else str(out / "asset" / f"{about['capture']['name']}.glb"))
    tell(f"verdict {about['verdict']}; {out / 'report.html'}")
    tell_gates(about)


def tell_gates(about: dict[str, Any]) -> None:
    """Tell failed gates and assumptions; a failed gate ends with exit code 3."""
    failed = 0
    for gate in about["gates"]:
        if gate["state"] in ("fail", "warn"):
            word = "gate failed" if gate["state"] == "fail" else "warning"
            cost = f", costs about {gate['cost_deg']:.0f}°" if gate["cost_deg"] >= 1 else ""
            tell(f"polcap: {word}: {gate['name']}: {gate['says']}{cost}. {gate['remedy']}.")
            failed += gate["state"] == "fail"
    if failed:
        raise GateError(f"{failed} of {len(about['gates'])} gates failed; the asset was written, see report.html")


class Steps:
    """What a long command tells while it works: a line per finished stage, and now and then one of the frames."""

    def __init__(self) -> None:
        self._begun = self._last = time.monotonic()

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """A stage begins (no seconds) or has ended."""
        if seconds is not None:
            print(f"{name:14}{'cached' if cached else f'{seconds:.2f} s'}", file=sys.stderr, flush=True)

    def frame(self, done: int, total: int) -> None:
        """So many of so many photographs are done."""
        now = time.monotonic()
        if now - self._last > _QUIET_S:
            self._last = now
            print(f"{done} of {total} frames, {self._left(done, total, now)} left", file=sys.stderr, flush=True)

    def _left(self, done: int, total: int, now: float) -> str:
        seconds = (now - self._begun) / done * (total - done)
        return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


class Bar(Steps):
    """The same on a terminal, in one line that changes."""

    def __init__(self, bar: "RichProgress", task: "TaskID") -> None:
        super().__init__()
        self._bar, self._task = bar, task

    def stage(self, name: str, seconds: float | None, cached: bool) -> None:
        """A stage begins (no seconds) or has ended."""
        self._bar.update(self._task, description=name, advance=0 if seconds is None else 1)

    def frame(self, done: int, total: int) -> None:
        """So many of so many photographs are done."""
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
