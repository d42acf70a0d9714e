"""The log of a capture's devices, rig.log: every command sent and every answer, one line each."""

import errno
import os
import threading
from datetime import datetime
from pathlib import Path

from polcap.formats import system_errors


class Log:
    """Appends lines such as `2026-11-21T18:30:12.123 rotator > 0ma00000000`; `Log(None)` writes nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()

    def write(self, device: str, mark: str, text: str) -> None:
        """Append a line: `>` sent, `<` received, `!` a note.

        Raises StorageError if the file cannot be written, but only once; later lines are lost without an error.
        """
        stamp = datetime.now().isoformat(timespec="milliseconds")
        with self._lock:
            if self._path is None:
                return
            try:
                if os.path.lexists(self._path) and (self._path.is_symlink() or not self._path.is_file()):
                    raise OSError(errno.EINVAL, "is no regular file; remove it")
                with self._path.open("a", encoding="utf-8", newline="\n") as file:
                    file.write(f"{stamp} {device} {mark} {text}\n")
            except OSError as error:
                path, self._path = self._path, None
                raise system_errors.cannot_write(path, error) from error

    def close(self) -> None:
        """Write no further lines to the log."""
        self._path = None
