"""The log of a capture's devices, rig.log: every command sent and every answer, one line each."""

import threading
from contextlib import suppress
from datetime import datetime
from io import TextIOWrapper
from pathlib import Path

from polcap.formats import atomic


class Log:
    """Appends lines such as `2026-11-21T18:30:12.123 rotator > 0ma00000000`; `Log(None)` writes nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._file: TextIOWrapper | None = None

    def write(self, device: str, mark: str, text: str) -> None:
        """Append a line: `>` sent, `<` received, `!` a note. The first line creates the file.

        Raises StorageError, once, if the file cannot be written; later lines are dropped.
        """
        stamp = datetime.now().isoformat(timespec="milliseconds")
        with self._lock:
            if self._path is None:
                return
            try:
                if self._file is None:
                    self._file = self._path.open("a", encoding="utf-8", newline="\n")
                self._file.write(f"{stamp} {device} {mark} {text}\n")
                self._file.flush()
            except OSError as error:
                path, self._path = self._path, None
                raise atomic.failure(path, error) from error

    def close(self) -> None:
        with self._lock:
            self._path = None
            if self._file is not None:
                with suppress(OSError):  # already reported by write
                    self._file.close()
