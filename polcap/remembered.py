"""In: what a figure or a piece of the page is made from. Out: itself, made once and kept in the result folder.

The store keeps what stages make; this keeps the small plain data that is made of their results afterwards, so that a
late change does not measure all of them again. What is damaged, or of another program or results, is made anew.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from polcap.formats import atomic, text_file
from polcap.formats.written import digest


class Remembered:
    """Plain data in work/remembered/ of a result folder, a file each.

    Parameters
    ----------
    out
        The result folder; None remembers nothing.
    program
        Digest of the program: what another made is made anew.
    anew
        Nothing of earlier runs is taken.
    """

    def __init__(self, out: Path | None = None, program: str = "", anew: bool = False) -> None:
        self._folder = None if out is None else out / "work" / "remembered"
        self._program, self._anew = program, anew
        self._found: dict[str, tuple[str, Any]] = {}  # of this run

    def __call__(self, name: str, made_from: Any, make: Callable[[], Any]) -> Any:
        """What `make` gives, or gave when it was made from the same.

        Parameters
        ----------
        name
            Of the file.
        made_from
            Plain JSON data: keys of results, settings.
        make
            Gives plain JSON data.

        Raises
        ------
        StorageError
            The folder cannot be written.
        """
        key = digest([self._program, made_from])
        known = self._found.get(name) or self._read(name)
        if known is None or known[0] != key:
            known = (key, json.loads(json.dumps(make())))
            self._write(name, *known)
        self._found[name] = known
        return known[1]

    def _read(self, name: str) -> tuple[str, Any] | None:
        if self._folder is None or self._anew:
            return None
        try:
            kept = text_file.read_json(self._folder / f"{name}.json")
        except (OSError, ValueError):
            return None
        if not isinstance(kept, Mapping) or kept.get("digest") != digest([kept.get("key"), kept.get("value")]):
            return None
        return str(kept["key"]), kept["value"]

    def _write(self, name: str, key: str, value: Any) -> None:
        if self._folder is None:
            return
        kept = {"key": key, "value": value, "digest": digest([key, value])}
        with atomic.path(self._folder / f"{name}.json", synced=False) as temporary:
            temporary.write_text(json.dumps(kept), encoding="utf-8")
