"""In: what a figure or a piece of the page is made from. Out: itself, made once and kept in the result folder.

The store keeps what stages make; this keeps the small plain data that is made of their results afterwards, so that a
late change does not measure all of them again. What is damaged, or of another program or results, is made anew.
"""

import json
from collections.abc import Callable
from hashlib import blake2b
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
            data = text_file.read_bytes(self._folder / f"{name}.json", text_file.TEXT_BYTES)
            made = data[len(_sealed(b"")) - 1 : -1]
            if data != _sealed(made):
                return None
            key, value = text_file.parse_json(made.decode())
        except (OSError, ValueError, TypeError):
            return None
        return str(key), value

    def _write(self, name: str, key: str, value: Any) -> None:
        if self._folder is None:
            return
        with atomic.path(self._folder / f"{name}.json", synced=False) as temporary:
            temporary.write_bytes(_sealed(json.dumps([key, value]).encode()))


def _sealed(made: bytes) -> bytes:
    """The file, a JSON document: the text in it is hashed as it stands, in a third of the time of writing it again."""
    head = f'{{"digest": "{blake2b(made, digest_size=16).hexdigest()}", "made": '
    return head.encode() + made + b"}"
