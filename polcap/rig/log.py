"""In: what was sent to a device and what it answered. Out: a text file, a line each, written as it happens."""

import threading
from contextlib import suppress
from datetime import datetime
from io import TextIOWrapper
from pathlib import Path

from polcap.formats import atomic


class Log:
    """`2026-11-21T18:30:12.123 rotator > 0ma00000000` per line; `Log(None)` keeps nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._file: TextIOWrapper | None = None
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8", newline="\n")
            except OSError as error:
                raise atomic.failure(path, error) from error

    def write(self, device: str, mark: str, text: str) -> None:
        """Append a line: `>` sent, `<` received, `!` noted.

        Raises
        ------
        StorageError
            The disk refuses; said once, after which nothing is kept.
        """
        stamp = datetime.now().isoformat(timespec="milliseconds")
        with self._lock:
            if self._file is None:
                return
            try:
                self._file.write(f"{stamp} {device} {mark} {text}\n")
                self._file.flush()
            except OSError as error:
                self._discard()
                assert self._path is not None
                raise atomic.failure(self._path, error) from error

    def close(self) -> None:
        with self._lock:
            self._discard()

    def _discard(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # what could not be flushed was reported when it was written
                file.close()
