"""The promises of the stage cache, on toy stages."""

import gc
import linecache
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import FunctionType
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import pytest

from polcap import images
from polcap.errors import StorageError
from polcap.formats.npy_folder import checksum, decode, encode, save
from polcap.pipeline.cache import Archive, Store, contents
from polcap.stages import Stage, stage


class Settings(msgspec.Struct, frozen=True):
    gain: Annotated[float, msgspec.Meta(gt=0)] = 2.0


@dataclass(frozen=True)
class Inner:
    array: images.Floats
    maybe: images.Floats | None
    shift: tuple[float, float]


@dataclass(frozen=True)
class Everything:
    inner: Inner
    source: Literal["a", "b"]
    cost: float
    order: tuple[int, ...]
    empty: images.Bits
    large: images.Floats
    flag: bool
    known: float | None
    table: Mapping[str, str]
    quality: images.Quality


def everything() -> Everything:
    return Everything(
        Inner(np.arange(6, dtype=np.float32).reshape(2, 3), None, (0.1, float("inf"))),
        "b",
        float("nan"),
        (2, 0, 1),
        np.zeros((0, 3), np.uint8),
        np.linspace(0, 1, 40_000).reshape(200, 200),
        True,
        None,
        {"licence": "CC0"},
        images.Quality.CLIPPED | images.Quality.DARK,
    )


calls: list[str] = []


@stage(version=1)
def double(value: float, settings: Settings) -> Inner:
    calls.append("double")
    return Inner(np.full((200, 200), value * settings.gain, np.float32), None, (value, 0.0))


@stage(version=1, keep=False)
def passing(inner: Inner) -> Inner:
    calls.append("passing")
    return replace(inner, array=inner.array + 1)


@stage(version=1)
def total(inner: Inner, scale: float | None) -> Inner:
    calls.append("total")
    return Inner(np.array([inner.array.sum()]), None, (scale or 0.0, 0.0))


def renamed(toy: Stage[..., Any], name: str) -> Stage[..., Any]:
    """The same stage as if it lived in a module of its own."""
    code, annotations = toy.function.__code__, toy.function.__annotations__
    copy = FunctionType(code, globals(), name)
    copy.__annotations__, copy.__module__ = annotations, f"toys.{name}"
    return Stage(copy, toy.version, toy.keep)


DOUBLE, PASSING, TOTAL = renamed(double, "double"), renamed(passing, "passing"), renamed(total, "total")


def path(store: Store, value: float = 3.0, gain: float = 2.0) -> Any:
    first = store.step(DOUBLE, value, config=Settings(gain))
    second = store.step(PASSING, first)
    scale = store.derive(lambda inner: inner.shift[0], first)
    return first, second, store.step(TOTAL, second, scale)


@pytest.fixture(autouse=True)
def no_calls() -> None:
    calls.clear()


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file of the cache; the measured seconds are the one thing that may differ."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.name not in ("lock", "owner"))
    return {
        str(file.relative_to(folder)): b"\n".join(
            line for line in file.read_bytes().split(b"\n") if not line.startswith(b' "seconds"')
        )
        for file in files
    }


def test_every_kind_of_field_comes_back_as_it_went(tmp_path: Path) -> None:
    value, arrays = everything(), dict[str, Any]()
    tree = encode(value, "value", arrays)
    for name, array in arrays.items():
        assert save(tmp_path / f"{name}.npy", array) == checksum(tmp_path / f"{name}.npy")
    back = decode(msgspec.json.decode(msgspec.json.encode(tree)), Everything, tmp_path)
    np.testing.assert_array_equal(back.inner.array, value.inner.array)
    np.testing.assert_array_equal(back.large, value.large)
    assert back.inner.array.dtype == np.float32 and back.empty.shape == (0, 3)
    assert back.inner.shift == (0.1, float("inf")) and np.isnan(back.cost)
    assert (back.source, back.order, back.flag) == ("b", (2, 0, 1), True)
    assert back.known is None and back.inner.maybe is None
    assert back.table == {"licence": "CC0"} and back.quality is value.quality


def test_values_with_functions_are_never_stored() -> None:
    network = images.Network(lambda x: {}, "d", ("s1",), {}, "CPU")
    with pytest.raises(TypeError, match="function cannot be kept"):
        encode(network, "value", {})


def test_second_run_computes_nothing(tmp_path: Path) -> None:
    first = path(Store(tmp_path))[2].value
    assert calls == ["double", "passing", "total"]
    calls.clear()
    second = path(Store(tmp_path))[2].value
    assert calls == []
    np.testing.assert_array_equal(first.array, second.array)


def test_results_are_read_only_the_first_time_and_the_second(tmp_path: Path) -> None:
    for _ in range(2):
        first, second, _ = path(Store(tmp_path))
        for kept in (first, second):
            with pytest.raises(ValueError, match="read-only"):
                kept.value.array[0, 0] = 1


def test_declaring_the_path_computes_nothing_and_writes_nothing(tmp_path: Path) -> None:
    steps = path(Store(tmp_path))
    assert calls == [] and not any(kept.ready for kept in steps) and list(tmp_path.iterdir()) == []


def test_until_stops_after_the_stage_and_computes_it_even_if_it_is_not_kept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    path(store)
    store.materialize(until="passing")
    assert calls == ["double", "passing"]


def test_a_setting_changes_the_key_of_its_stage_and_of_all_after_it(tmp_path: Path) -> None:
    path(Store(tmp_path))[2]
    before, after = path(Store(tmp_path)), path(Store(tmp_path), gain=3.0)
    assert all(a.key != b.key for a, b in zip(before, after, strict=True))


def test_a_version_changes_the_key(tmp_path: Path) -> None:
    raised = Stage(DOUBLE.function, 2, True)
    one, two = (Store(tmp_path).step(s, 3.0, config=Settings()) for s in (DOUBLE, raised))
    assert one.key != two.key


def test_key_follows_the_bytes_of_the_photographs_not_their_place(tmp_path: Path) -> None:
    frame = images.Frame("/a/x.dng", images.Exif(), "shot", "digest", load=lambda: None)
    capture = images.Capture(
        "a", "/a", (images.Shot(0.0, (frame,)),), "folders", 1.0, True, (0.0, 0.0), (2, 2), notes=("n",)
    )
    elsewhere = images.Shot(0.0, (replace(frame, path="/b/x.dng"),))
    moved = replace(capture, folder="/b", name="b", shots=(elsewhere,))
    other = replace(capture, shots=(images.Shot(0.0, (replace(frame, digest="other"),)),))
    turned = replace(capture, shots=(images.Shot(0.1, (frame,)),))
    key = [Store(tmp_path).step(DOUBLE, c, config=Settings()).key for c in (capture, moved, other, turned)]
    assert key[0] == key[1] and len(set(key)) == 3


def test_force_computes_the_stage_and_what_follows(tmp_path: Path) -> None:
    path(Store(tmp_path))[2].materialize()
    calls.clear()
    store = Store(tmp_path, force="double")
    path(store)
    store.materialize()
    assert calls == ["double", "passing", "total"]
    calls.clear()
    store = Store(tmp_path, force="total")
    path(store)
    store.materialize()
    assert calls == ["passing", "total"]


@pytest.mark.parametrize("harm", ["flip", "truncate", "remove"])
def test_damaged_result_is_noticed_and_computed_again(tmp_path: Path, harm: str) -> None:
    path(Store(tmp_path))[0].materialize()
    file = tmp_path / "work" / "01-double" / "value.array.npy"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    if harm == "remove":
        file.unlink()
    else:
        file.write_bytes(data if harm == "flip" else data[:100])
    calls.clear()
    assert float(path(Store(tmp_path))[0].value.array[0, 0]) == 6.0
    assert calls == ["double"]


def edited(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("3.0", "4.0"),
        ('"format": 3', '"format": 1'),
        ("value.array.npy", "../../value.array.npy"),
        ('"value": {', '"value": null, "x": {'),
        ('"files": {', '"files": null, "x": {'),
        ("{", "[" * 30_000),
    ],
)
def test_an_edited_manifest_is_noticed_and_computed_again(tmp_path: Path, old: str, new: str) -> None:
    path(Store(tmp_path))[0].materialize()
    place = tmp_path / "work" / "01-double"
    edited(place / "manifest.json", old, new)
    with pytest.raises(StorageError, match=r"run `polcap process`"):
        _ = path(Archive(tmp_path))[0].value
    calls.clear()
    assert path(Store(tmp_path))[0].value.shift == (3.0, 0.0)
    assert calls == ["double"]


@pytest.mark.parametrize(
    "tree",
    [
        None, [], {"array": None, "maybe": None, "shift": [0.0, 1.0]}, {"array": {"array": "../a.npy"}},
        {"array": {"array": "/a.npy"}, "maybe": None, "shift": [0.0, 1.0]},
        {"array": {"array": "a.npy"}, "maybe": None, "shift": [0.0]},
        {"array": {"array": "a.npy"}, "maybe": None, "shift": ["much", 1.0]},
        {"array": {"array": "a.npy"}, "maybe": None, "shift": [True, 1.0]},
        {"array": {"array": "gone.npy"}, "maybe": None, "shift": [0.0, 1.0]},
        {"array": {"array": "a.npy"}, "maybe": None, "shift": [0.0, 1.0], "more": 1},
    ],
)  # fmt: skip
def test_a_tree_of_another_form_is_refused(tmp_path: Path, tree: Any) -> None:
    save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(StorageError):
        decode(tree, Inner, tmp_path)


def test_an_edited_function_changes_the_key_of_what_it_derives(tmp_path: Path) -> None:
    source, keys = "def half(inner):\n    return inner.shift[0] / {}\n", []
    for divisor in (2, 2, 3):
        file = tmp_path / "toy.py"
        file.write_text(source.format(divisor), encoding="utf-8")
        linecache.clearcache()
        names: dict[str, Any] = {}
        exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), names)
        store = Store(tmp_path)
        keys.append(store.derive(names["half"], store.step(DOUBLE, 3.0, config=Settings())).key)
    assert keys[0] == keys[1] != keys[2]


def test_a_store_that_is_done_with_leaves_no_memory_map_behind(tmp_path: Path) -> None:
    gc.collect()
    gc.disable()  # what is freed here is freed at once
    try:
        for _ in range(5):
            path(Store(tmp_path))[0].value  # noqa: B018
        assert not any(str(tmp_path) in str(o.filename) for o in gc.get_objects() if isinstance(o, np.memmap))
    finally:
        gc.enable()


def test_two_processes_never_work_in_one_folder(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from polcap.pipeline.cache import Store\n"
        "with Store(Path(sys.argv[1])).lock(): print('held', flush=True); time.sleep(600)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(StorageError, match=f"process {other.pid} is working"), Store(tmp_path).lock():
            pass
    finally:
        other.kill()
        other.wait()
    with Store(tmp_path).lock():  # of a dead process: taken over
        pass


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_cache import Store, path
store = Store(Path(sys.argv[1]))
print("ready", flush=True)
with store.lock():
    path(store)
    store.materialize()
"""


def test_killed_stage_leaves_no_half_result_and_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    store = Store(whole)
    with store.lock():
        path(store)
        store.materialize()
    random = np.random.default_rng(1)
    for attempt in range(6):
        folder = tmp_path / f"killed{attempt}"
        here = str(Path(__file__).parent)
        run = subprocess.Popen([sys.executable, "-c", KILLED, str(folder), here], stdout=subprocess.PIPE)
        assert run.stdout is not None and run.stdout.readline() == b"ready\n"
        time.sleep(float(random.uniform(0, 0.012)))
        run.send_signal(signal.SIGKILL)
        run.wait()
        for about in contents(folder):  # whatever stands under a final name is whole
            place = folder / "work" / about["folder"]
            assert {f.name for f in place.iterdir()} == {*about["files"], "manifest.json"}
        store = Store(folder)
        with store.lock():
            path(store)
            store.materialize()
        assert snapshot(folder) == snapshot(whole)


@pytest.mark.parametrize(("number", "word"), [(28, "disk is full"), (30, "read-only"), (13, "permission")])
def test_a_disk_that_refuses_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, word: str
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(StorageError, match=word) as caught:
        path(Store(tmp_path))[0].materialize()
    assert "\n" not in str(caught.value)
    assert list((tmp_path / "work").iterdir()) == []


def test_an_alias_of_an_array_type_is_read_as_the_array(tmp_path: Path) -> None:
    """From Python 3.12 on NumPy's NDArray is a `type` alias, whose origin is itself."""
    import types
    from typing import get_origin

    from polcap.formats import npy_folder

    class Alias:
        __value__ = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

    npy_folder.save(tmp_path / "value.npy", np.arange(3.0))
    hint = types.GenericAlias(Alias, (float,))
    assert get_origin(hint) is Alias
    assert np.array_equal(npy_folder.decode({"array": "value.npy"}, hint, tmp_path), np.arange(3.0))


@stage(version=1)
def painted(value: float) -> Inner:
    return Inner(np.full((600, 600), value, np.float32), np.full(3, value, np.float32), (value, 0.0))


def test_facts_are_known_without_reading_the_pictures(tmp_path: Path) -> None:
    Store(tmp_path).step(painted, 2.0).materialize()
    (file,) = tmp_path.glob("work/*/value.array.npy")
    file.write_bytes(file.read_bytes()[:-4] + b"\0\0\0\0")  # damage that nobody who reads facts alone can see
    again = Store(tmp_path).step(painted, 2.0)
    facts = again.facts
    assert facts.shift == (2.0, 0.0) and np.array_equal(facts.maybe, np.full(3, 2.0))
    assert facts.array.shape == (600, 600)
    with pytest.raises(TypeError, match="not read"):
        np.asarray(facts.array)
    assert (again.value.array == 2).all()  # damaged, and so made anew


def test_facts_of_what_is_not_stored_are_the_value(tmp_path: Path) -> None:
    step = Store(tmp_path).step(painted, 2.0)
    assert step.facts is step.value


ASKED = threading.Event()


def slow(value: float) -> float:
    calls.append("slow")
    assert ASKED.wait(60)
    return value


def quick(value: float) -> float:
    ASKED.set()
    return value


def test_one_result_does_not_wait_for_another_and_is_made_once(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first, second = store.derive(slow, 2.0), store.derive(quick, 3.0)
    with ThreadPoolExecutor(3) as pool:
        waiting = [pool.submit(getattr, first, "value") for _ in range(2)]
        assert pool.submit(getattr, second, "value").result(60) == 3.0
        assert [one.result(60) for one in waiting] == [2.0, 2.0]
    assert calls == ["slow"]
