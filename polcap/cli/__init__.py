"""The command line: one module per command.

stdout carries data only; progress and messages go to stderr. Exit codes: 0 done, 2 the input or a setting is at fault,
3 the asset was written but a gate failed, 4 hardware, 130 interrupted (run again to go on), 1 a bug. Heavy imports
happen inside the commands, so that `--help` answers at once. `options` declares the options of several commands.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

from polcap import __version__, terminal
from polcap.cli.batch_command import batch
from polcap.cli.board_command import board
from polcap.cli.calibrate_command import calibrate
from polcap.cli.capture_command import capture
from polcap.cli.check_command import check
from polcap.cli.doctor_command import doctor
from polcap.cli.export_command import export
from polcap.cli.fuse_command import fuse
from polcap.cli.material_command import material
from polcap.cli.process_command import process
from polcap.cli.result_commands import clean, report, show, status
from polcap.cli.settings_command import keys_named, settings
from polcap.cli.synth_command import synth
from polcap.cli.training_commands import evaluate, train
from polcap.cli.validate_command import validate
from polcap.errors import SettingError

_ANYWHERE = ("--debug", "-q", "--quiet", "-v", "--verbose", "--log")  # options that may follow the command


class OneLineErrors(TyperGroup):
    """Command group that reports a wrong command line in one line, as all other errors."""

    def main(self, args: Sequence[str] | None = None, *rest: Any, standalone_mode: bool = True, **extra: Any) -> Any:
        """Parse the command line and run the command; exits with its code unless `standalone_mode` is false."""
        stated = list(sys.argv[1:] if args is None else args)
        words = _common_first(stated)
        if "help" in words[:1]:  # polcap help COMMAND
            words = [*words[1:], "--help"]
        try:
            code = super().main(words, *rest, **{**extra, "standalone_mode": False})
        except TyperException as error:
            if not standalone_mode:
                raise
            text, code = _one_line(error), error.exit_code
            terminal.print_message(text, "ERROR")
            asked = {"json": "--json" in words}  # a faulty command line has no parsed options
            terminal.print_error_document(asked, SettingError(), text.removeprefix("polcap: error: "), code)
        except typer.Abort:  # a question without an answer
            terminal.print_message("polcap: aborted")
            code = 130
        if standalone_mode:
            sys.exit(terminal.final_code(code or 0))
        return code


def _common_first(words: Sequence[str]) -> list[str]:
    """Reorder the words of a command line: options that all commands share are moved in front of the command."""
    if words[-1:] == ["--log"]:  # its file is missing, which the parser reports
        return ["--log"]
    common, others = list[str](), list[str]()
    for before, word in zip(["", *words], words):
        is_common = word.partition("=")[0] in _ANYWHERE or before == "--log"
        (common if is_common else others).append(word)
    return common + others


def _one_line(error: TyperException) -> str:
    """Message for a wrong command line, with a hint to --help; a page of help is returned unchanged."""
    text = error.format_message()
    if "\n" in text:
        return text
    text = text.rstrip(".").replace("Value error, ", "")
    if "unexpected extra argument" in text:
        text += "; put a path with spaces in quotes"
    context = getattr(error, "ctx", None)
    if "such option" in text and context is not None and any("--set" in known.opts for known in context.command.params):
        option = str(getattr(error, "option_name", ""))
        keys = keys_named(option, str(context.info_name))
        text = f"no such option: {option}; it is a setting: --set {keys[0]}=…" if len(keys) == 1 else text
    asked = "polcap" if context is None or context.parent is None else f"polcap {context.info_name}"
    see = "" if text.endswith("?") else f"; see `{asked} --help`"
    return f"polcap: error: {text[:1].lower()}{text[1:]}{see}"


COMMANDS = (
    process, batch, fuse, material, export, show, status, report, clean, check, settings, calibrate, validate, doctor,
    synth, board, capture, train, evaluate,
)  # fmt: skip
app = typer.Typer(
    cls=OneLineErrors,
    help="Turns flash photographs taken through a rotating polarizer into a relightable 3-D asset.",
    epilog="`polcap help COMMAND` explains a command, `polcap settings STAGE` the settings of a stage. "
    "--debug, -q, -v and --log may follow the command.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # plain help: half the start-up time
    pretty_exceptions_enable=False,
)
for command in COMMANDS:
    summary = (command.__doc__ or "").partition(". ")[0].rstrip(".")
    app.command(short_help=f"{summary}.")(terminal.reported(command))


def main() -> None:
    """The `polcap` command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # results must not depend on the number of threads
    terminal.open_streams()
    app()


def _version(asked: bool) -> None:
    """Option --version: print the version and exit."""
    if asked:
        print(__version__)
        raise typer.Exit


@app.callback()
def common_options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of a failure.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress, only data and errors.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print a line per frame and stage, and all gates.")
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="FILE", help="Append all messages to a file, with times and versions."),
    ] = None,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="Print the version and end.")
    ] = False,
) -> None:
    terminal.set_verbosity(quiet, verbose, debug)
    try:
        terminal.open_log(log)
    except OSError as error:
        raise typer.BadParameter(f"{log}: {error.strerror}; choose another file", param_hint="'--log'") from error
