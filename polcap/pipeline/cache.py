"""The stage cache: the result of each stage in its folder `work/NN-name/`, reused while its key is the same.

A key is a digest of the stage's name and version, its settings and the keys of its inputs. The first inputs are the
bytes of the RAW files and of the model file, not their paths, so a capture may be moved. A folder contains one `.npy`
file per array, and `manifest.json`. It is written under a temporary name and renamed, so a killed run leaves a complete
result or none. When a result is read, sizes and SHA-256 digests are compared; a damaged result is computed again. `run`
returns arrays as read-only memory maps, whether the result was computed or read. A process compares a file's digest
once, as long as the file's size and times stay the same.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import msgspec
import numpy as np

from polcap import parallel, resource_limits
from polcap.errors import StorageError
from polcap.formats import atomic, npy_folder
from polcap.pipeline.manifest import FORMAT, digest, read_manifest, seal
from polcap.stages import Stage

T = TypeVar("T")
_READERS = 2  # threads that compute digests: more do not read faster
_verified: set[tuple[Any, ...]] = set()  # path, times, size and digest of the files that this process has compared
Progress = Callable[[str, float | None, bool], None]  # stage, seconds (None: it begins), found in the cache


def silent(stage: str, seconds: float | None, cached: bool) -> None:
    """Progress callback that shows nothing."""


class StageReached(Exception):
    """Exception that ends the path early, after the last stage that the user asked for."""


@dataclass(frozen=True)
class StageResult(Generic[T]):
    """Result of a stage of the path and its cache key."""

    key: str
    value: T


class DeferredResult(StageResult[T]):
    """Result whose value is made when it is first needed."""

    def __init__(self, key: str, make: Callable[[], T]) -> None:
        vars(self).update(key=key, make=make)  # a frozen dataclass

    @cached_property
    def value(self) -> T:
        """The result."""
        made: T = vars(self)["make"]()
        return made


def together(results: Sequence[StageResult[T]]) -> StageResult[tuple[T, ...]]:
    """Several results as one input of a stage; their values are made when it needs them."""
    key = digest([one.key for one in results])
    return DeferredResult(key, lambda: tuple(one.value for one in results))


class MemoryCache:
    """Runs the stages of one path, in order, and holds their results in memory; nothing is written.

    `force` names a stage that is computed again even if its result is stored, as are all stages after it.
    """

    until: str | None = None  # the stage after which StageReached ends the path

    def __init__(self, progress: Progress = silent, force: str | None = None) -> None:
        self.progress = progress
        self.results: dict[str, StageResult[Any]] = {}  # of the path so far, by stage
        self.stage, self._began = "start", 0.0  # the stage begun last, and when
        self._force, self._forced = force, False
        self._held: dict[str, Any] = {}  # by key

    def run(self, stage: Stage[..., T], *inputs: Any, config: msgspec.Struct | None = None) -> StageResult[T]:
        """The result of a stage, from the cache or computed. Inputs are other results, plain values or functions.

        Raises StageReached: this was the stage at which the path was to stop. StorageError: as `ArchiveCache`.
        """
        self.results[stage.name] = self._result(stage, inputs, config)
        if stage.name == self.until:
            raise StageReached(stage.name)
        return self.results[stage.name]

    def derive(self, function: Callable[..., T], *inputs: Any) -> StageResult[T]:
        """Compute a value from stage results by a cheap function; never stored, its key has the function's name."""
        return StageResult(_derived_key(function, inputs), function(*map(value_of, inputs)))

    def begin(self, stage: str) -> None:
        """Report to the progress display that work on a stage begins."""
        self.stage, self._began = stage, time.perf_counter()
        self.progress(stage, None, False)

    def end(self) -> None:
        """Report to the progress display that work on the current stage has ended."""
        self.progress(self.stage, time.perf_counter() - self._began, False)

    @contextmanager
    def memory_explained(self, pixels: int) -> Iterator[None]:
        """Context manager: lack of memory becomes a SettingError that names the stage; `pixels` of a RAW frame."""
        try:
            yield
        except Exception as error:
            if not resource_limits.is_shortfall(error):
                raise
            raise resource_limits.shortfall(error, self.stage, pixels) from error

    def _result(self, stage: Stage[..., T], inputs: tuple[Any, ...], config: msgspec.Struct | None) -> StageResult[T]:
        about = _about(stage, inputs, config)
        self._forced = self._forced or stage.name == self._force
        return StageResult(about["key"], self._value(stage, inputs, config, about))

    def _value(
        self, stage: Stage[..., T], inputs: tuple[Any, ...], config: msgspec.Struct | None, about: dict[str, Any]
    ) -> Any:
        """The value of a stage's result, read from the cache or computed."""
        value = None if self._forced else self._find(stage, about["key"])
        if value is not None:
            if stage.keep:
                self.progress(stage.name, 0.0, True)
            return value
        values = [value_of(one) for one in inputs]  # in a `LazyCache`, this runs the earlier stages
        self.begin(stage.name)
        value = stage(*values, *(() if config is None else (config,)))
        value = self._store(stage, value, about, time.perf_counter() - self._began)
        self.end()
        return value

    def _find(self, stage: Stage[..., T], key: str) -> T | None:
        """The stored value of a stage's result with this key; None: it must be computed."""
        return self._held.get(key)

    def _store(self, stage: Stage[..., T], value: T, about: dict[str, Any], seconds: float) -> T:
        """Store the computed value of a stage's result; returns it read-only."""
        npy_folder.freeze(value)
        self._held[about["key"]] = value
        return value


class StageCache(MemoryCache):
    """The stage cache of one result folder: results in `folder/work`."""

    def __init__(self, folder: Path, progress: Progress = silent, force: str | None = None) -> None:
        super().__init__(progress, force)
        self.folder, self.work = folder, folder / "work"

    def place(self, stage: Stage[..., Any]) -> Path:
        """Folder in which the result of a stage is stored: of a stage of the path so far, or of the next one."""
        names = list(self.results)
        number = names.index(stage.name) if stage.name in names else len(names)
        return self.work / f"{number + 1:02d}-{stage.name}"

    def _find(self, stage: Stage[..., T], key: str) -> T | None:
        place = self.place(stage)
        if not stage.keep or read_manifest(place).get("key") != key:
            return None
        try:
            return read(place, stage)
        except StorageError:  # damaged: computed again
            return None

    def _store(self, stage: Stage[..., T], value: T, about: dict[str, Any], seconds: float) -> T:
        """Store the result of a stage in its folder, completely or not at all; returns it as memory maps."""
        if not stage.keep:
            npy_folder.freeze(value)
            return value
        place = self.place(stage)
        with atomic.folder_of_files(place, "manifest.json", synced=False) as temporary:
            arrays: npy_folder.Arrays = {}
            tree = npy_folder.encode(value, "value", arrays)
            saves = [partial(npy_folder.save, temporary / f"{name}.npy", array) for name, array in arrays.items()]
            files = dict(zip([f"{name}.npy" for name in arrays], parallel.results(saves)))
            about = {**about, "seconds": round(seconds, 3), "files": files, "value": tree}
            text = json.dumps({**about, "digest": seal(about)}, indent=1, allow_nan=False)
            (temporary / "manifest.json").write_text(text, encoding="utf-8")
        return read(place, stage, check=False)


class LazyCache(StageCache):
    """Stage cache that reads or computes a result only when its value is needed: not for stored results."""

    def _result(self, stage: Stage[..., T], inputs: tuple[Any, ...], config: msgspec.Struct | None) -> StageResult[T]:
        about = _about(stage, inputs, config)
        return DeferredResult(about["key"], partial(self._value, stage, inputs, config, about))

    def derive(self, function: Callable[..., T], *inputs: Any) -> StageResult[T]:
        """A value derived from stage results, not yet computed; its key has the function's name."""
        return DeferredResult(_derived_key(function, inputs), lambda: function(*map(value_of, inputs)))


class DryRunCache(StageCache):
    """Cache for a dry run: finds out by keys alone which stages are cached; nothing is read or computed."""

    def __init__(self, folder: Path, force: str | None = None) -> None:
        super().__init__(folder, force=force)
        self.states: dict[str, str] = {}  # of every stage: cached, compute, or on demand where it is never stored

    def derive(self, function: Callable[..., T], *inputs: Any) -> StageResult[T]:
        """The key of a derived value; the value is not computed."""
        return StageResult[Any](_derived_key(function, inputs), None)

    def _value(
        self, stage: Stage[..., T], inputs: tuple[Any, ...], config: msgspec.Struct | None, about: dict[str, Any]
    ) -> Any:
        cached = not self._forced and read_manifest(self.place(stage)).get("key") == about["key"]
        self.states[stage.name] = "on demand" if not stage.keep else "cached" if cached else "compute"


class ArchiveCache(StageCache):
    """Cache of an earlier run whose photographs are missing, so that the keys of the first stages cannot be computed.

    A stored result is used if it was made from the results of the stages before it, with these settings and versions.
    A StorageError names a result made otherwise, missing or damaged. A result that is never stored is computed.
    """

    def _result(self, stage: Stage[..., T], inputs: tuple[Any, ...], config: msgspec.Struct | None) -> StageResult[T]:
        if not stage.keep:
            return super()._result(stage, inputs, config)
        place = self.place(stage)
        about, value = read_manifest(place), read(place, stage)
        # "": an input that is no stage's result, whose key cannot be known here
        expected = [one.key if isinstance(one, StageResult) else "" for one in inputs if not callable(one)]
        pairs = zip(expected, about["inputs"])
        same_inputs = len(expected) == len(about["inputs"]) and all(key in ("", stored) for key, stored in pairs)
        if not same_inputs or (about["version"], about["settings"]) != (stage.version, msgspec.to_builtins(config)):
            raise StorageError(
                f"{place} is of another run than the stages before it, or of another polcap; run `polcap process` again"
            )
        return StageResult(about["key"], value)

    def derive(self, function: Callable[..., T], *inputs: Any) -> StageResult[T]:
        """As in other caches; without a key if an input is missing, such as the user's mask."""
        found = super().derive(function, *inputs)
        return StageResult("", found.value) if None in inputs else found


def _about(stage: Stage[..., Any], inputs: tuple[Any, ...], config: msgspec.Struct | None) -> dict[str, Any]:
    """The data that determine a stage's result (name, version, settings, input keys), and the key made of them."""
    about = {
        "format": FORMAT,
        "stage": stage.name,
        "version": stage.versions,
        "settings": msgspec.to_builtins(config),
        "inputs": [key_of(one) for one in inputs if not callable(one)],  # a function does not change a result
    }
    return {**about, "key": digest(list(about.values()))}


def _derived_key(function: Callable[..., Any], inputs: tuple[Any, ...]) -> str:
    return digest(["derived", function.__name__, [key_of(one) for one in inputs]])


def read(place: Path, stage: Stage[..., T], check: bool = True) -> T:
    """Read a stored stage result, its arrays as read-only memory maps; `check` compares digests.

    Raises StorageError: there is no result of this cache format, a file is missing, or a file was changed.
    """
    about = read_manifest(place)
    if not about:
        raise StorageError(f"{place}: no whole result of this polcap's cache format {FORMAT}; run `polcap process`")
    if check:
        files = [place / name for name in about["files"]]
        with ThreadPoolExecutor(_READERS) as pool:
            list(pool.map(_verify, files, about["files"].values()))
    value: T = npy_folder.decode(about["value"], get_type_hints(stage.function)["return"], place)
    return value


def _verify(file: Path, expected: list[Any]) -> None:
    """Compare a file with its size and digest as of `npy_folder.checksum`; once in this process, until it changes.

    Raises StorageError: the file is missing, or it was changed.
    """
    try:
        stat = file.stat()
        identity = str(file), stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, *expected
        if identity not in _verified and npy_folder.checksum(file) == expected:
            _verified.add(identity)
    except OSError:
        identity = ()  # never in the set
    if identity not in _verified:
        raise StorageError(f"{file} is damaged; delete {file.parent} and run again")


def value_of(value: Any) -> Any:
    """The value of a stage's input: of a `StageResult` its value, else the input itself."""
    return value.value if isinstance(value, StageResult) else value


def key_of(value: Any) -> str:
    """The cache key of a stage's input: of a `StageResult` its key, else a digest of the input."""
    return value.key if isinstance(value, StageResult) else digest(fingerprint(value))


def fingerprint(value: Any) -> Any:
    """Convert an input to plain data for a cache key: equal for two inputs that give the same results."""
    if isinstance(value, np.ndarray):
        contiguous = np.ascontiguousarray(value)
        content_digest = sha256(contiguous.data.cast("B") if contiguous.size else b"")
        return [str(contiguous.dtype), list(contiguous.shape), content_digest.hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        names = [one.name for one in fields(value) if one.metadata.get("in_key", True)]
        return [type(value).__name__, {name: fingerprint(getattr(value, name)) for name in names}]
    if isinstance(value, msgspec.Struct):
        return fingerprint(msgspec.to_builtins(value))
    if isinstance(value, Mapping):
        return {str(name): fingerprint(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [fingerprint(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value).hex()
    if value is None or isinstance(value, (str, int, bool)):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be an input of a stage")
