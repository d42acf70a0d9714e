"""Opens all files that polcap did not just write; reads TOML and JSON, explains errors in keys, makes TOML text.

Files are UTF-8, with or without a byte order mark. The functions return plain data, or raise an `OSError` or a
`ValueError` with a message of one line. A pipe, a huge file, deep nesting, infinite numbers and NUL characters are
refused.
"""

import difflib
import errno
import json
import os
import re
import stat
import sys
import tomllib
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

TEXT_BYTES = 16 << 20  # the capture.toml of a large capture has about 20 kB
_STEP = re.compile(r"\.([^.\[`]+)|\[(\d+)\]")  # of a path such as $.frame[0].role
_UNKNOWN = re.compile(r"Object contains unknown field `(.*)`")
_Type = TypeVar("_Type", bound=inspect.Type)


def opened(path: str | Path) -> BufferedReader:
    """Open a regular file for reading; a pipe or a device is refused. Raises OSError."""
    if "\0" in os.fspath(path):
        raise OSError(errno.EINVAL, "its name holds a NUL character", str(path))
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is no regular file", str(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: str | Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes. Raises OSError."""
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"is larger than {limit / 2**20:g} MiB", str(path))
        return file.read(size)


def read_text(path: str | Path, limit: int = TEXT_BYTES) -> str:
    """The text of a regular file of at most `limit` bytes. Raises OSError, or ValueError: it is not UTF-8."""
    return read_bytes(path, limit).decode("utf-8-sig")


def read_toml(path: str | Path, finite: bool = True) -> dict[str, Any]:
    """Read a TOML file of any origin as plain data, as `parse_toml`. Raises OSError or ValueError."""
    return parse_toml(read_text(path), finite)


def read_json(path: str | Path) -> Any:
    """Read a JSON file of any origin as plain data. Raises OSError or ValueError."""
    return parse_json(read_text(path))


def parse_toml(text: str, finite: bool = True) -> dict[str, Any]:
    """Parse TOML text; `finite` refuses NaN and infinity. ValueError if it is not TOML, or as `check_plain`."""
    try:
        found = tomllib.loads(text)
        check_plain(found, finite)
    except tomllib.TOMLDecodeError as error:
        hint = "; put a text in quotes" if str(error).startswith("Invalid value") else ""
        raise ValueError(f"{error}{hint}") from None
    except RecursionError:
        raise ValueError("nested too deeply") from None
    return found


def parse_json(text: str) -> Any:
    """Parse JSON text; ValueError if it is not JSON, or as `check_plain`."""
    try:
        found = json.loads(text)
        check_plain(found)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    return found


def to_toml(tree: dict[str, Any]) -> str:
    """TOML text of a table: None is left out, arrays become lists, numbers get nine digits."""
    import tomli_w

    return tomli_w.dumps(_plain(tree))


def _plain(tree: Any) -> Any:
    """Nested data as TOML takes them: no None, no arrays, floats of nine digits."""
    if isinstance(tree, dict):
        return {key: _plain(value) for key, value in tree.items() if value is not None}
    if hasattr(tree, "tolist"):
        return _plain(tree.tolist())
    if isinstance(tree, (list, tuple)):
        return [_plain(value) for value in tree]
    return float(f"{tree:.9g}") if isinstance(tree, float) else tree


def check_plain(value: Any, finite: bool = True, name: str = "") -> None:
    """Raise a ValueError that names a NUL character or, with `finite`, a number that is not finite, in plain data."""
    if isinstance(value, str) and "\0" in value:
        raise ValueError(f"{name or 'a text'} holds a NUL character")
    if finite and isinstance(value, (int, float)) and not abs(value) <= sys.float_info.max:
        raise ValueError(f"{f'{name} = ' * bool(name)}{str(value)[:20]} is not a finite number")
    if isinstance(value, dict):
        for key, item in value.items():
            check_plain(key)
            check_plain(item, finite, f"{name}.{key}" if name else str(key))
    if isinstance(value, list):
        for index, item in enumerate(value):
            check_plain(item, finite, f"{name}[{index}]")


def suggestion(name: str, known: Iterable[str]) -> str:
    """The most similar known name as a question, or all of them where none is similar."""
    choices = list(known)
    similar = difflib.get_close_matches(name.lower(), choices, n=1, cutoff=0.5)
    return f"did you mean {similar[0]}?" if similar else f"there are {', '.join(choices)}"


def fault(error: msgspec.ValidationError, data: Any, kind: type[msgspec.Struct]) -> str:
    """Explain msgspec's validation error about `data`: key, value, and limit or the most similar valid key."""
    message, _, path = str(error).partition(" - at `$")
    value, form = data, inspect.type_info(kind)
    for name, place in _STEP.findall(path):
        value, form = value[int(place) if place else name], _element_type(form, name)
    where = path.strip("`.")
    if unknown := _UNKNOWN.fullmatch(message):
        known = [field.encode_name for field in _require(form, inspect.StructType).fields]
        return f"{f'{where}.' if where else ''}{unknown[1]}: there is no such key; {suggestion(unknown[1], known)}"
    if message.startswith("Invalid enum value"):
        message = f"not one of {', '.join(map(str, _require(form, inspect.LiteralType).values))}"
    elif "matching regex" in message:
        message = "no such choice"
    elif message.startswith("Expected `str`"):
        message = "is not text; put it in quotes"
    text = f"{message[:1].lower()}{message[1:]}"
    if not where or isinstance(value, (dict, list, tuple)):
        return f"{where}: {text}" if where else text
    return f"{where} = {value!r}: {text}"


def _element_type(form: inspect.Type, name: str) -> inspect.Type:
    """msgspec's type description of a table's key or of a list's element."""
    if name:
        return next(field.type for field in _require(form, inspect.StructType).fields if field.encode_name == name)
    for kind in (inspect.VarTupleType, inspect.ListType):
        if (found := _member(form, kind)) is not None:
            return found.item_type
    return inspect.AnyType()  # a list of fixed length: of numbers only


def _require(form: inspect.Type, kind: type[_Type]) -> _Type:
    found = _member(form, kind)
    assert found is not None, f"{form} is no {kind.__name__}"
    return found


def _member(form: inspect.Type, kind: type[_Type]) -> _Type | None:
    """The member of a union type description that is of class `kind`, or the type itself; None if there is none."""
    members = form.types if isinstance(form, inspect.UnionType) else (form,)
    for member in members:
        while isinstance(member, inspect.Metadata):
            member = member.type
        if isinstance(member, kind):
            return member
    return None
