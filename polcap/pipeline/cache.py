"""In: a stage and its inputs. Out: its result, computed once and kept in the result folder.

Nothing is computed when a step is declared: a `StageResult` knows its key and finds its value when it
is asked for. So one description of the path serves a run, a dry run, `--until` and `show`.

The key of a result is a digest of the stage's name, its version, its own settings and the keys of
its inputs, chained back to the bytes of the RAW files and of the model file. Where files lie is not
part of it: a capture may be moved. A result is one folder, `work/NN-name/`: an `.npy` per array and
a `manifest.json`. Folders are written beside and renamed, so a killed run leaves a whole result or none;
what a power cut leaves of one is known by its digests, and computed again. Arrays come back as read-only
memory maps, the first time as after a resume.

The manifest carries its own digest, so an edited scalar is seen as an edited pixel is. Each array's size
and SHA-256 digest are checked once per process, when a stage that has to run (or a writer) first opens
the result; what nobody reads is not hashed. That is one pass at about 1.6 GB/s. A result that fails any
check is computed again.
"""

import inspect
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from hashlib import blake2b, sha256
from pathlib import Path
from threading import RLock
from typing import Any, Generic, TypeVar, cast, get_type_hints

import msgspec
import numpy as np
from filelock import FileLock, Timeout

from polcap.errors import StorageError
from polcap.formats import atomic, npy_folder
from polcap.stages import Stage

T = TypeVar("T")
_READERS = 2  # threads that compare digests: the memory gives no more
FORMAT = 3  # of work/; raised when older folders can no longer be read
UNDIGESTED = ("seconds", "digest")  # of a manifest: no two runs take the same time
Progress = Callable[[str, float | None, bool], None]  # stage, seconds (None: begins), found in the cache


def silent(stage: str, seconds: float | None, cached: bool) -> None:
    """The progress of someone who does not look."""


class Result(Generic[T]):
    """A value of the path: its key now, the value when asked for."""

    _value: T

    def __init__(self, key: str) -> None:
        self.key = key
        self._asked = RLock()  # of each its own: to ask for one does not wait for another

    @property
    def value(self) -> T:
        """Found or computed at the first asking, once whichever threads ask."""
        with self._asked:
            if not self.known:
                self._value = self.find()
            return self._value

    @property
    def known(self) -> bool:
        """The value has been asked for."""
        return hasattr(self, "_value")

    def find(self) -> T:
        """The value, from wherever it can be had."""
        raise NotImplementedError


class Derived(Result[T]):
    """A small value made from results; not a stage, never kept."""

    def __init__(self, key: str, function: Callable[..., T], inputs: tuple[Any, ...]) -> None:
        super().__init__(key)
        self.function = function
        self.inputs = inputs

    def find(self) -> T:
        """The function of the inputs' values."""
        return self.function(*map(value_of, self.inputs))


@dataclass(frozen=True)
class Run:
    """What all results of one store share."""

    progress: Progress
    fresh: set[str] = field(default_factory=set)  # keys that --force has declared stale in this process


class StageResult(Result[T]):
    """The result of a stage, kept in a folder of its own."""

    _facts: T

    def __init__(
        self,
        key: str,
        stage: Stage[..., T],
        inputs: tuple[Any, ...],
        config: msgspec.Struct | None,
        place: Path,
        run: Run,
    ) -> None:
        super().__init__(key)
        self.stage = stage
        self.inputs = inputs
        self.config = config
        self.place = place
        self.run = run

    @property
    def facts(self) -> T:
        """The value; of large arrays only the shapes, where nobody has read them yet."""
        with self._asked:
            if not hasattr(self, "_facts"):
                self._facts = self._small()
            return self._facts

    def _small(self) -> T:
        if not self.known and self.stored():
            try:
                found = read(self.place, returns(self.stage), most=npy_folder.LARGE + npy_folder.HEAD)
                return cast(T, npy_folder.without_large(found))
            except StorageError:  # the value is made anew
                pass
        return self.value

    @property
    def name(self) -> str:
        return self.stage.name

    @property
    def keep(self) -> bool:
        return self.stage.keep

    @property
    def ready(self) -> bool:
        """The value is known, or a whole manifest with this key lies in the folder."""
        return self.known or self.stored()

    def stored(self) -> bool:
        """A whole manifest with this key lies in the folder, and nobody asked for it anew."""
        return self.keep and self.key not in self.run.fresh and manifest(self.place).get("key") == self.key

    def materialize(self) -> None:
        """See to it that the result exists; one that is not kept waits until it is needed."""
        if self.keep and not self.ready:
            _ = self.value

    def find(self) -> T:
        """From the folder; where it is damaged, or of another key, by computing it."""
        if self.stored():
            try:
                result: T = read(self.place, returns(self.stage))
                return result
            except StorageError:  # damaged: nothing is lost but time
                pass
        return self.compute()

    def compute(self) -> T:
        """Run the stage on its inputs' values, and keep what it gives."""
        values = [*map(value_of, self.inputs), *(() if self.config is None else (self.config,))]
        self.run.progress(self.name, None, False)
        start = time.perf_counter()
        result = self.stage(*values)
        if self.keep:
            self.write(result, time.perf_counter() - start)
            self.run.fresh.discard(self.key)
            result = read(self.place, returns(self.stage), check=False)
        else:
            npy_folder.freeze(result)
        self.run.progress(self.name, time.perf_counter() - start, False)
        return result

    def write(self, result: T, seconds: float) -> None:
        """Put a result into its folder, whole or not at all."""
        with atomic.folder(self.place, synced=False) as temporary:
            arrays: npy_folder.Arrays = {}
            tree = npy_folder.encode(result, "value", arrays)
            files = {f"{name}.npy": npy_folder.save(temporary / f"{name}.npy", a) for name, a in arrays.items()}
            about = {
                "format": FORMAT,
                "stage": self.name,
                "version": self.stage.version,
                "key": self.key,
                "settings": msgspec.to_builtins(self.config),
                "inputs": [key_of(value) for value in self.inputs],
                "seconds": round(seconds, 3),
                "files": files,
                "value": tree,
            }
            text = json.dumps({**about, "digest": seal(about)}, indent=1, allow_nan=False)
            (temporary / "manifest.json").write_text(text, encoding="utf-8")


class ArchivedResult(StageResult[T]):
    """A kept result of a run whose photographs are gone: taken as it is, whatever its key."""

    def stored(self) -> bool:
        """A whole manifest lies in the folder, whatever its key."""
        return self.keep and bool(manifest(self.place))

    def find(self) -> T:
        """From the folder; what is not kept is computed from what is."""
        if self.keep:
            result: T = read(self.place, returns(self.stage))
            return result
        return self.compute()


class Store:
    """The stage cache of one result folder, `folder/work`."""

    result: type[StageResult[Any]] = StageResult

    def __init__(self, folder: Path, progress: Progress = silent, force: str | None = None) -> None:
        self.work = folder / "work"
        self.run = Run(progress)
        self.force = force
        self.steps: list[StageResult[Any]] = []

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out of this result folder.

        The system drops the lock when its owner dies, however it dies: there are no stale locks.

        Raises
        ------
        StorageError
            Another process works here, or the folder cannot be written.
        """
        lock, owner = FileLock(self.work / "lock", timeout=0), self.work / "owner"
        try:
            self.work.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout as error:
            raise StorageError(
                f"{self.work.parent}: process {_first_line(owner)} is working here; wait for it or choose another --out"
            ) from error
        except OSError as error:
            raise atomic.failure(self.work / "lock", error) from error
        try:
            with atomic.path(owner, synced=False) as temporary:
                temporary.write_text(f"{os.getpid()}\n", encoding="utf-8")
            for left in [*self.work.glob(".*.part*"), *self.work.glob(".*.old")]:  # of a killed run
                atomic.discard(left)
            yield
        finally:
            lock.release()

    def step(self, stage: Stage[..., T], *inputs: Any, config: msgspec.Struct | None = None) -> StageResult[T]:
        """Declare the next step of the path; inputs are other results or plain values."""
        key = digest([FORMAT, stage.name, stage.version, msgspec.to_builtins(config), list(map(key_of, inputs))])
        if stage.name == self.force or self._stale(inputs):
            self.run.fresh.add(key)
        place = self.work / f"{len(self.steps) + 1:02d}-{stage.name}"
        result = self.result(key, stage, inputs, config, place, self.run)
        self.steps.append(result)
        return result

    def derive(self, function: Callable[..., T], *inputs: Any) -> Derived[T]:
        """A small value made from results, for the next step to take.

        Its key holds the function's source text: an edited function makes what follows anew.
        """
        key = digest(["derived", function.__qualname__, inspect.getsource(function), list(map(key_of, inputs))])
        if self._stale(inputs):
            self.run.fresh.add(key)
        return Derived(key, function, inputs)

    def materialize(self, until: str | None = None, after: str | None = None) -> None:
        """Compute what is missing, in order, from behind the stage `after` up to and with the stage `until`."""
        first = 0 if after is None else [result.name for result in self.steps].index(after) + 1
        for result in self.steps[first:]:
            if result.keep and result.ready:
                self.run.progress(result.name, 0.0, True)
            result.materialize()
            if result.name == until:
                if not result.keep:
                    _ = result.value  # so that its errors show
                return

    def _stale(self, inputs: tuple[Any, ...]) -> bool:
        return any(isinstance(value, Result) and value.key in self.run.fresh for value in inputs)


class Archive(Store):
    """A finished result folder opened again without its capture: what was kept is taken as it is."""

    result = ArchivedResult


def manifest(place: Path) -> dict[str, Any]:
    """What a kept result says of itself; empty where there is none, or it is not what was written."""
    try:
        about = json.loads((place / "manifest.json").read_text(encoding="utf-8"))
        whole = isinstance(about, dict) and about.get("format") == FORMAT and about.get("digest") == seal(about)
    except (OSError, ValueError, RecursionError):
        return {}
    return about if whole else {}


def seal(about: Mapping[str, Any]) -> str:
    """Digest of a manifest's own text."""
    return digest({name: value for name, value in about.items() if name not in UNDIGESTED})


def read(place: Path, hint: Any, check: bool = True, most: float = math.inf) -> Any:
    """The value in a result folder, its arrays as read-only memory maps.

    Parameters
    ----------
    place
        The folder.
    hint
        Type of the value.
    check
        Compare what lies there with the digests of what was written.
    most
        Bytes of a file; larger ones are not compared.

    Raises
    ------
    StorageError
        There is none of this cache format, a file is missing, or bytes are not those that were written.
    """
    about = manifest(place)
    if not about:
        raise StorageError(f"{place}: no whole result of this polcap's cache format {FORMAT}; run `polcap process`")
    compared = {place / name: told for name, told in about["files"].items() if told[0] <= most} if check else {}
    with ThreadPoolExecutor(_READERS) as pool:
        for (file, expected), found in zip(compared.items(), pool.map(_checksum, compared)):
            if found != expected:
                raise StorageError(f"{file} is damaged; delete {place} and run again")
    return npy_folder.decode(about["value"], hint, place)


def _checksum(file: Path) -> list[Any] | None:
    """As `npy_folder.checksum`; None where the file cannot be read."""
    try:
        return npy_folder.checksum(file)
    except OSError:
        return None


def returns(stage: Stage[..., Any]) -> Any:
    """The type a stage promises to return."""
    return get_type_hints(stage.function)["return"]


def digest(value: Any) -> str:
    """Key of plain, nested data."""
    return blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()


def value_of(value: Any) -> Any:
    """What a stage is given for an input."""
    return value.value if isinstance(value, Result) else value


def key_of(value: Any) -> str:
    """What an input puts into the keys of what is made from it."""
    return value.key if isinstance(value, Result) else digest(fingerprint(value))


def fingerprint(value: Any) -> Any:
    """Plain data that is equal for two inputs exactly when a stage could not tell them apart."""
    if isinstance(value, np.ndarray):
        solid = np.ascontiguousarray(value)
        summed = sha256(solid.data.cast("B") if solid.size else b"")
        return [str(solid.dtype), list(solid.shape), summed.hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        facts = [one.name for one in fields(value) if one.metadata.get("in_key", True)]
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


def contents(folder: Path) -> list[dict[str, Any]]:
    """The manifests in a result folder in the order of the stages, each with its size in bytes."""
    found = []
    for place in sorted((folder / "work").glob("[0-9][0-9]-*")):
        about = manifest(place)
        if about:
            size = sum(entry.stat().st_size for entry in place.iterdir())
            found.append({**about, "folder": place.name, "bytes": size})
    return found


def _first_line(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")[:20].strip() or "unknown"
    except OSError:
        return "unknown"
