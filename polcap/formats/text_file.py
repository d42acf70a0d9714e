"""In: the path of a text file that anybody may have written. Out: its content, as TOML or JSON.

It is UTF-8, with or without a byte order mark. Whatever stands there, a reader gets plain data or an `OSError` or
`ValueError` of one line: no pipe is waited for, no number is without end, no nesting too deep, no value infinite.
"""

import errno
import json
import math
import os
import stat
import tomllib
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

_PART = 1 << 22  # bytes that are read at a time
TEXT_BYTES = 16 << 20  # the manifest of a large capture has some 20 kB


def opened(path: str | Path) -> BinaryIO:
    """A regular file, opened to be read; a pipe or a device is refused, never waited for. Raises OSError."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is no regular file", str(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: str | Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes. Raises OSError."""
    with opened(path) as file:
        stated = min(os.fstat(file.fileno()).st_size, limit)  # no room is taken for what is not there
        data = file.read(stated + 1)  # at once: putting parts together takes ten times as long
        left = limit + 1 - len(data)
        while left and (part := file.read(min(left, _PART))):  # it grew, or the system stated no size
            data += part
            left -= len(part)
    if not left:
        raise OSError(errno.EFBIG, f"is larger than {limit / 2**20:g} MiB", str(path))
    return data


def read_toml(path: str | Path, finite: bool = True) -> dict[str, Any]:
    """A TOML document; unless `finite`, its numbers may be NaN. Raises OSError or ValueError."""
    return parse_toml(read_bytes(path, TEXT_BYTES).decode("utf-8-sig"), finite)


def read_json(path: str | Path) -> Any:
    """A JSON document. Raises OSError or ValueError."""
    return parse_json(read_bytes(path, TEXT_BYTES).decode("utf-8-sig"))


def parse_toml(text: str, finite: bool = True) -> dict[str, Any]:
    """TOML text as plain data; ValueError where it is none, or a number in it is not finite though it shall be."""
    try:
        found = tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if finite:
        check_finite(found)
    return found


def parse_json(text: str) -> Any:
    """JSON text as plain data; ValueError where it is none, or a number in it is not finite."""
    try:
        return json.loads(text, parse_constant=_refuse, parse_float=_finite)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def check_finite(value: Any, name: str = "") -> None:
    """ValueError names the first number in plain data that is infinite or NaN."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} = {value} is not a finite number")
    if isinstance(value, dict):
        for key, item in value.items():
            check_finite(item, f"{name}.{key}" if name else str(key))
    if isinstance(value, list):
        for at, item in enumerate(value):
            check_finite(item, f"{name}[{at}]")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")
