"""Stores a frozen dataclass as JSON and one .npy file per array in a folder, and reads it back.

The JSON holds the scalars and the names of the array files. A value that does not fit the expected type is a
`StorageError`.
"""

import io
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import Enum, IntEnum, IntFlag
from hashlib import file_digest, sha256
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from polcap.errors import StorageError
from polcap.formats import text_file

Arrays = dict[str, NDArray[Any]]
_MAPPED = 1 << 16  # bytes; smaller files are read at once, as a map costs a page table and a handle


def encode(value: Any, name: str, arrays: Arrays) -> Any:
    """Convert a value to JSON data; its arrays are added to `arrays` under dotted names. Raises TypeError."""
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{name}: an array of Python objects cannot be stored")
        arrays[name] = value
        return {"array": f"{name}.npy"}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: encode(getattr(value, f.name), f"{name}.{f.name}", arrays) for f in fields(value)}
    if isinstance(value, (tuple, list)):
        return [encode(item, f"{name}.{index}", arrays) for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        return {key: encode(item, f"{name}.{key}", arrays) for key, item in value.items()}
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else str(float(value))  # JSON knows no NaN
    if isinstance(value, (IntEnum, IntFlag, np.integer)):
        return int(value)
    if isinstance(value, np.bool_):
        return bool(value)
    if value is None or isinstance(value, (str, int, bool)):
        return value
    raise TypeError(f"{name}: a {type(value).__name__} cannot be stored")


def decode(tree: Any, hint: Any, folder: Path) -> Any:
    """Rebuild a value of type `hint` from JSON data of `encode`; arrays are read from `folder`. Raises StorageError."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if tree is None and NoneType in inner:
            return None
        return decode(tree, next(arm for arm in inner if arm is not NoneType), folder)
    if hasattr(origin, "__value__"):  # a `type` alias, as NumPy's NDArray is from Python 3.12 on
        origin = get_origin(origin.__value__)
    if origin is np.ndarray or hint is np.ndarray:
        return load(_array_file(tree, folder))
    if is_dataclass(hint) and isinstance(hint, type):
        hints = get_type_hints(hint)
        names = {field.name for field in fields(hint)}
        if isinstance(tree, dict) and tree.keys() != names:
            raise StorageError(f"{folder}: its {hint.__name__} is that of another polcap; run `polcap process` again")
        _expect(isinstance(tree, dict), tree, hint.__name__, folder)
        return hint(**{name: decode(item, hints[name], folder) for name, item in tree.items()})
    if origin is tuple:
        _expect(isinstance(tree, list), tree, "a list", folder)
        kinds = inner[:1] * len(tree) if inner[1:] == (...,) else inner
        _expect(len(tree) == len(kinds), tree, f"{len(kinds)} values", folder)
        return tuple(decode(item, kind, folder) for item, kind in zip(tree, kinds, strict=True))
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        _expect(isinstance(tree, dict), tree, "a table", folder)
        return {key: decode(item, inner[1], folder) for key, item in tree.items()}
    if origin is Literal:
        _expect(tree in inner, tree, f"one of {inner}", folder)
        return tree
    return _scalar(tree, hint, folder)


def _scalar(tree: Any, hint: Any, folder: Path) -> Any:
    """A number, text or Enum of a manifest, checked against its type. Raises StorageError."""
    if hint is float and isinstance(tree, str):
        _expect(tree in ("nan", "inf", "-inf"), tree, "a number", folder)
        return float(tree)
    if hint is float:
        _expect(isinstance(tree, (int, float)) and not isinstance(tree, bool), tree, "a number", folder)
        return float(tree)
    if isinstance(hint, type) and issubclass(hint, Enum):
        _expect(isinstance(tree, int) and tree >= 0, tree, hint.__name__, folder)
        return hint(tree)
    _expect(type(tree) is hint, tree, getattr(hint, "__name__", str(hint)), folder)
    return tree


def _array_file(tree: Any, folder: Path) -> Path:
    """File of an array that a manifest names. Raises StorageError: it names no file in this folder."""
    name = tree.get("array") if isinstance(tree, dict) else None
    _expect(isinstance(name, str) and Path(name).name == name, tree, "an array's file", folder)
    return folder / str(name)


def _expect(holds: bool, tree: Any, wanted: str, folder: Path) -> None:
    """Raise a StorageError unless the data `tree` are what is `wanted`, in words."""
    if not holds:
        raise StorageError(f"{folder}: expected {wanted}, found {str(tree)[:60]!r}; run `polcap process` again")


def save(file: Path, array: NDArray[Any]) -> list[Any]:
    """Write an array of any shape as an .npy file; returns the file's size and SHA-256 digest, as `checksum` does."""
    array = np.asarray(array, order="C")
    header = io.BytesIO()
    np.lib.format.write_array_header_2_0(header, np.lib.format.header_data_from_array_1_0(array))
    digest, size = sha256(), 0
    with file.open("wb") as stream:
        for part in (header.getbuffer(), array.reshape(-1).view(np.uint8).data if array.size else b""):
            digest.update(part)
            size += stream.write(part)
    return [size, digest.hexdigest()]


def load(file: Path) -> NDArray[Any]:
    """Open an array of any shape: as a read-only memory map if large and its drive has maps. Raises StorageError."""
    try:
        if file.stat().st_size > _MAPPED:
            with suppress(OSError):
                return np.asarray(np.load(file, mmap_mode="r", allow_pickle=False))
        with text_file.opened(file) as stream:
            array: NDArray[Any] = np.load(stream, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise StorageError(f"{file} cannot be read; delete {file.parent} and run again") from error
    array.flags.writeable = False
    return array


def checksum(file: Path) -> list[Any]:
    """Size in bytes and SHA-256 digest of a file, to detect damage."""
    with text_file.opened(file) as stream:
        return [file.stat().st_size, file_digest(stream, "sha256").hexdigest()]


def freeze(value: Any) -> None:
    """Make all arrays of a value read-only, as arrays read from the stage cache are."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            freeze(getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        for item in value:
            freeze(item)
