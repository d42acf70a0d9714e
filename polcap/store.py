"""In: a stage and its inputs. Out: its result, computed once and kept in the result folder.

Nothing is computed when a step is declared: a `Kept` knows its key and finds its value when it is
asked for. So one description of the path serves a run, a dry run, `--until` and `show`.

The key of a result is a digest of the stage's name, its version, its own settings and the keys of
its inputs, chained back to the bytes of the RAW files and of the model file. Where files lie is not
part of it: a capture may be moved. A result is one folder, `work/NN-name/`: an `.npy` per array and
a `manifest.json`. Folders are written beside, fsynced and renamed, so a killed run leaves a whole
result or none. Arrays come back as read-only memory maps, the first time as after a resume.

Each file's size and BLAKE2b digest are checked once per process, when a stage that has to run (or a
writer) first opens the result; what nobody reads is not hashed. That is one pass at about 1 GB/s.
A result that fails the check is computed again.
"""

import fcntl
import io
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum, IntFlag
from hashlib import blake2b
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Generic, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from polcap.errors import StorageError
from polcap.formats import atomic
from polcap.stages import Stage

T = TypeVar("T")
FORMAT = 1  # of work/; raised when older folders can no longer be read
WHERE = ("path", "folder", "name", "notes")  # fields that say where or how, not what: never part of a key
Progress = Callable[[str, float | None, bool], None]  # stage, seconds (None: begins), found in the cache


def silent(stage: str, seconds: float | None, cached: bool) -> None:
    """The progress of someone who does not look."""


@dataclass
class Kept(Generic[T]):
    """The result of a step: its key now, its value when asked for."""

    name: str
    key: str
    settings: msgspec.Struct | None
    find: Callable[[], T]
    stored: Callable[[], bool]  # a whole result with this key lies in the folder
    keep: bool

    @property
    def value(self) -> T:
        if not hasattr(self, "_value"):
            self._value = self.find()
        return self._value

    @property
    def ready(self) -> bool:
        return hasattr(self, "_value") or self.stored()

    def settle(self) -> None:
        """See to it that the result exists; a result that is not kept waits until it is needed."""
        if self.keep and not self.ready:
            _ = self.value


class Store:
    """The stage cache of one result folder, `folder/work`."""

    def __init__(self, folder: Path, progress: Progress = silent, force: str | None = None) -> None:
        self.work = folder / "work"
        self.progress = progress
        self.force = force
        self.steps: list[Kept[Any]] = []
        self._fresh: set[str] = set()  # keys that --force has declared stale in this process

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out of this result folder.

        The kernel drops the lock when its owner dies, however it dies: there are no stale locks.

        Raises
        ------
        StorageError
            Another process works here, or the folder cannot be written.
        """
        file = self.work / "lock"
        try:
            self.work.mkdir(parents=True, exist_ok=True)
            handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise atomic.failure(file, error) from error
        try:
            self._seize(handle)
            for left in [*self.work.glob(".*.part"), *self.work.glob(".*.old")]:  # of a killed run
                atomic.discard(left)
            yield
        finally:
            os.close(handle)

    def _seize(self, handle: int) -> None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(handle, 0)
            os.pwrite(handle, str(os.getpid()).encode(), 0)
        except BlockingIOError as error:
            owner = os.pread(handle, 20, 0).decode(errors="replace") or "unknown"
            raise StorageError(
                f"{self.work.parent}: process {owner} is working here; wait for it or choose another --out"
            ) from error
        except OSError as error:
            raise atomic.failure(self.work / "lock", error) from error

    def step(self, stage: Stage[..., T], *inputs: Any, config: msgspec.Struct | None = None) -> Kept[T]:
        """Declare the next step of the path; inputs are other steps' results or plain values."""
        keys = [_key(value) for value in inputs]
        key = digest([FORMAT, stage.name, stage.version, msgspec.to_builtins(config), keys])
        upstream = {value.key for value in inputs if isinstance(value, Kept)}
        if stage.name == self.force or upstream & self._fresh:
            self._fresh.add(key)
        place = self.work / f"{len(self.steps) + 1:02d}-{stage.name}"
        given = () if config is None else (config,)

        def compute() -> T:
            values = [value.value if isinstance(value, Kept) else value for value in inputs]
            self.progress(stage.name, None, False)
            start = time.perf_counter()
            result = stage(*values, *given)
            if stage.keep:
                seconds = time.perf_counter() - start
                self._write(place, stage, key, config, inputs, result, seconds)
                self._fresh.discard(key)
                result = read(place, returns(stage), check=False)
            else:
                freeze(result)
            self.progress(stage.name, time.perf_counter() - start, False)
            return result

        def stored() -> bool:
            return stage.keep and key not in self._fresh and manifest(place).get("key") == key

        def find() -> T:
            if stored():
                try:
                    result: T = read(place, returns(stage))
                    return result
                except StorageError:  # damaged: nothing is lost but time
                    pass
            return compute()

        kept = Kept(stage.name, key, config, find, stored, stage.keep)
        self.steps.append(kept)
        return kept

    def derive(self, function: Callable[..., T], *inputs: Any) -> Kept[T]:
        """A small value made from results, for the next step to take; not a stage, never kept."""

        def find() -> T:
            return function(*(value.value if isinstance(value, Kept) else value for value in inputs))

        key = digest(["derived", function.__qualname__, [_key(value) for value in inputs]])
        if {value.key for value in inputs if isinstance(value, Kept)} & self._fresh:
            self._fresh.add(key)
        return Kept(function.__name__, key, None, find, lambda: False, False)

    def settle(self, until: str | None = None) -> None:
        """Compute what is missing, in order, up to and with the stage `until`."""
        for kept in self.steps:
            if kept.keep and kept.ready:
                self.progress(kept.name, 0.0, True)
            kept.settle()
            if kept.name == until:
                _ = kept.value  # also where it is not kept, so that its errors show
                return

    def _write(
        self,
        place: Path,
        stage: Stage[..., T],
        key: str,
        config: msgspec.Struct | None,
        inputs: tuple[Any, ...],
        result: T,
        seconds: float,
    ) -> None:
        with atomic.folder(place) as temporary:
            arrays: dict[str, np.ndarray[Any, Any]] = {}
            tree = encode(result, "value", arrays)
            files = {}
            for name, array in arrays.items():
                files[f"{name}.npy"] = save(temporary / f"{name}.npy", array)
            about = {
                "stage": stage.name,
                "version": stage.version,
                "key": key,
                "settings": msgspec.to_builtins(config),
                "inputs": [_key(value) for value in inputs],
                "seconds": round(seconds, 3),
                "files": files,
                "value": tree,
            }
            text = json.dumps(about, indent=1, allow_nan=False)
            (temporary / "manifest.json").write_text(text, encoding="utf-8")


def manifest(place: Path) -> dict[str, Any]:
    """What a kept result says of itself; empty where there is none, or it is not whole."""
    try:
        about = json.loads((place / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}


def read(place: Path, hint: Any, check: bool = True) -> Any:
    """The value in a result folder, its arrays as read-only memory maps.

    Raises
    ------
    StorageError
        A file is missing or its bytes are not those that were written.
    """
    about = manifest(place)
    for name, expected in about.get("files", {}).items() if check else ():
        try:
            found = checksum(place / name)
        except OSError:
            found = None
        if found != expected:
            raise StorageError(f"{place / name} is damaged; delete {place} and run again")
    if "value" not in about:
        raise StorageError(f"{place}: no result here; run `polcap process` again")
    return decode(about["value"], hint, place)


def returns(stage: Stage[..., Any]) -> Any:
    """The type a stage promises to return."""
    return get_type_hints(stage.function)["return"]


def checksum(file: Path) -> list[Any]:
    """Size in bytes and BLAKE2b digest of a file."""
    summed = blake2b(digest_size=16)
    with file.open("rb") as stream:
        while block := stream.read(1 << 22):
            summed.update(block)
    return [file.stat().st_size, summed.hexdigest()]


def digest(value: Any) -> str:
    """Key of plain, nested data."""
    return blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()


def _key(value: Any) -> str:
    return value.key if isinstance(value, Kept) else digest(fingerprint(value))


def fingerprint(value: Any) -> Any:
    """Plain data that is equal for two inputs exactly when a stage could not tell them apart."""
    if isinstance(value, np.ndarray):
        solid = np.ascontiguousarray(value)
        summed = blake2b(solid.data.cast("B") if solid.size else b"", digest_size=16)
        return [str(solid.dtype), list(solid.shape), summed.hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        facts = [field.name for field in fields(value) if field.compare and field.name not in WHERE]
        return [type(value).__name__, {name: fingerprint(getattr(value, name)) for name in facts}]
    if isinstance(value, Mapping):
        return {str(name): fingerprint(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [fingerprint(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value).hex()
    if value is None or isinstance(value, (str, int, bool)):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be an input of a stage")


def encode(value: Any, name: str, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """JSON for a value of images.py; its arrays go into `arrays` under dotted names."""
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{name}: an array of Python objects cannot be kept")
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
    raise TypeError(f"{name}: a {type(value).__name__} cannot be kept")


def decode(tree: Any, hint: Any, place: Path) -> Any:
    """The value of type `hint` that `encode` made `tree` of."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if tree is None:
            return None
        return decode(tree, next(arm for arm in inner if arm is not NoneType), place)
    if isinstance(tree, dict) and tree.keys() == {"array"}:
        return load(place / tree["array"])
    if is_dataclass(hint) and isinstance(hint, type):
        hints = get_type_hints(hint)
        return hint(**{name: decode(item, hints[name], place) for name, item in tree.items()})
    if origin is tuple:
        kinds = inner[:1] * len(tree) if inner[1:] == (...,) else inner
        return tuple(decode(item, kind, place) for item, kind in zip(tree, kinds, strict=True))
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: decode(item, inner[1], place) for key, item in tree.items()}
    if origin is Literal or hint in (Any, NoneType):
        return tree
    return hint(tree)  # float, int, bool, str, an Enum


def save(file: Path, array: np.ndarray[Any, Any]) -> list[Any]:
    """Write one .npy; returns its `checksum`. Unlike numpy.save it tells why a write failed."""
    array = np.asarray(array, order="C")
    head = io.BytesIO()
    np.lib.format.write_array_header_2_0(head, np.lib.format.header_data_from_array_1_0(array))
    summed, size = blake2b(digest_size=16), 0
    with file.open("wb") as stream:
        for part in (head.getbuffer(), array.reshape(-1).view(np.uint8).data if array.size else b""):
            summed.update(part)
            size += stream.write(part)
    return [size, summed.hexdigest()]


def load(file: Path) -> np.ndarray[Any, Any]:
    """One array: a read-only memory map, or in memory where it is small."""
    try:
        if file.stat().st_size > 1 << 16:
            return np.asarray(np.load(file, mmap_mode="r", allow_pickle=False))
        array: np.ndarray[Any, Any] = np.load(file, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise StorageError(f"{file} cannot be read; delete {file.parent} and run again") from error
    array.flags.writeable = False
    return array


def freeze(value: Any) -> None:
    """Make the arrays of a result that is not kept read-only, as those that are."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            freeze(getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        for item in value:
            freeze(item)


def contents(folder: Path) -> list[dict[str, Any]]:
    """The manifests in a result folder in the order of the stages, each with its size in bytes."""
    found = []
    for place in sorted((folder / "work").glob("[0-9][0-9]-*")):
        about = manifest(place)
        if about:
            size = sum(entry.stat().st_size for entry in place.iterdir())
            found.append({**about, "folder": place.name, "bytes": size})
    return found


class Archive(Store):
    """A finished result folder opened again without its capture: what was kept is taken as it is."""

    def step(self, stage: Stage[..., T], *inputs: Any, config: msgspec.Struct | None = None) -> Kept[T]:
        """The stored result whatever its key; what is never kept is computed from the stored ones."""
        kept = super().step(stage, *inputs, config=config)
        if stage.keep:
            place = self.work / f"{len(self.steps):02d}-{stage.name}"
            kept.find = lambda: cast(T, read(place, returns(stage)))
            kept.stored = lambda: bool(manifest(place))
        return kept
