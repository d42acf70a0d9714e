"""`polcap process --watch`: process a folder again whenever its files change."""

from collections.abc import Callable
from pathlib import Path

from polcap import terminal
from polcap.errors import GateError, InputError, SettingError


def at_every_change(capture: Path, target: Path, config: Path | None, once: Callable[[], None]) -> None:
    """Call `once` now and after each change of the capture folder or the settings file; print its errors.

    Raises SettingError if there is no such folder, or the settings are wrong from the start.
    """
    from polcap import config as settings
    from polcap.formats.capture import arrivals

    if not capture.is_dir():
        raise SettingError(f"{capture} is no folder; --watch needs the folder that the photographs go to")
    settings.load(config, ())
    for _ in arrivals.settled(capture, target, edited=[] if config is None else [config]):
        try:
            once()
        except (InputError, GateError, OSError) as error:  # a frame may have gone while it was read
            terminal.print_message(f"polcap: {terminal.line(error)}")
        terminal.print_progress(f"watching {capture}; Ctrl-C ends")
