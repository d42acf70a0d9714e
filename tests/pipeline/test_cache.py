"""The promises of the stage cache, on toy stages."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import FunctionType
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import pytest

from polcap import capture_values, image_values
from polcap.errors import SettingError, StorageError
from polcap.formats import npy_folder, own_files
from polcap.formats.npy_folder import checksum, decode, encode, save
from polcap.pipeline import result_folder, result_place
from polcap.pipeline.cache import (
    ArchiveCache,
    DryRunCache,
    LazyCache,
    MemoryCache,
    StageCache,
    StageReached,
    StageResult,
)
from polcap.pipeline.manifest import contents
from polcap.stages import Stage, stage


class Settings(msgspec.Struct, frozen=True):
    gain: Annotated[float, msgspec.Meta(gt=0)] = 2.0


@dataclass(frozen=True)
class Inner:
    array: image_values.Floats
    maybe: image_values.Floats | None
    shift: tuple[float, float]


@dataclass(frozen=True)
class Everything:
    inner: Inner
    source: Literal["a", "b"]
    cost: float
    order: tuple[int, ...]
    empty: image_values.Bits
    large: image_values.Floats
    flag: bool
    known: float | None
    table: Mapping[str, str]
    quality: image_values.Quality


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
        image_values.Quality.CLIPPED | image_values.Quality.DARK,
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


@dataclass(frozen=True)
class Toys:
    """The results of the toy path."""

    double: StageResult[Inner]
    passing: StageResult[Inner]
    total: StageResult[Inner]


def path(cache: MemoryCache, value: float = 3.0, gain: float = 2.0) -> Toys:
    first = cache.run(DOUBLE, value, config=Settings(gain))
    second = cache.run(PASSING, first)
    scale = cache.derive(shift, first)
    return Toys(first, second, cache.run(TOTAL, second, scale))


def shift(inner: Inner) -> float:
    return inner.shift[0]


@pytest.fixture(autouse=True)
def no_calls() -> None:
    calls.clear()


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file of the cache; the measured seconds are the one thing that may differ."""
    files = sorted(
        file for file in folder.rglob("*") if file.is_file() and file.name not in ("lock", "owner", own_files.RECORD)
    )
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
    with pytest.raises(TypeError, match="function cannot be stored"):
        encode({"run": lambda x: {}}, "value", {})


def test_second_run_computes_only_what_is_never_stored(tmp_path: Path) -> None:
    first = path(StageCache(tmp_path)).total.value
    assert calls == ["double", "passing", "total"]
    calls.clear()
    second = path(StageCache(tmp_path)).total.value
    assert calls == ["passing"]
    np.testing.assert_array_equal(first.array, second.array)


@pytest.mark.parametrize("in_memory", [True, False])
def test_results_are_read_only_the_first_time_and_the_second(tmp_path: Path, in_memory: bool) -> None:
    memory = MemoryCache()
    for _ in range(2):
        made = path(memory if in_memory else StageCache(tmp_path))
        for result in (made.double, made.passing):
            with pytest.raises(ValueError, match="read-only"):
                result.value.array[0, 0] = 1


def test_a_cache_in_memory_computes_each_stage_once_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cache = MemoryCache()
    first, second = path(cache), path(cache)
    assert calls == ["double", "passing", "total"] and first == second
    path(cache, gain=3.0)
    assert calls == 2 * ["double", "passing", "total"] and list(tmp_path.iterdir()) == []


def test_the_path_ends_after_the_stage_at_which_it_was_to_stop(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    cache.until = "passing"
    with pytest.raises(StageReached):
        path(cache)
    assert calls == ["double", "passing"] and list(cache.results) == ["double", "passing"]


def test_a_dry_run_tells_each_state_and_computes_nothing(tmp_path: Path) -> None:
    cache = DryRunCache(tmp_path)
    path(cache)
    assert cache.states == {"double": "compute", "passing": "on demand", "total": "compute"}
    assert calls == [] and list(tmp_path.iterdir()) == []
    path(StageCache(tmp_path))
    calls.clear()
    for force, states in (
        (None, {"double": "cached", "passing": "on demand", "total": "cached"}),
        ("total", {"double": "cached", "passing": "on demand", "total": "compute"}),
    ):
        cache = DryRunCache(tmp_path, force)
        path(cache)
        assert cache.states == states and calls == []


def keys(toys: Toys) -> list[str]:
    return [result.key for result in vars(toys).values()]


def test_a_setting_changes_the_key_of_its_stage_and_of_all_after_it(tmp_path: Path) -> None:
    before, after = keys(path(DryRunCache(tmp_path))), keys(path(DryRunCache(tmp_path), gain=3.0))
    assert all(a != b for a, b in zip(before, after, strict=True))


def test_keys_are_the_same_with_every_cache(tmp_path: Path) -> None:
    made = [keys(path(cache)) for cache in (DryRunCache(tmp_path), MemoryCache(), StageCache(tmp_path))]
    made.append(keys(path(ArchiveCache(tmp_path), value=0.0)))  # of other photographs, as far as it knows
    assert made[0] == made[1] == made[2] == made[3]


@pytest.mark.parametrize("gain", [2.0, 3.0])
def test_stages_of_two_runs_are_never_joined(tmp_path: Path, gain: float) -> None:
    """Neither with the settings of the first run, nor with those of the second, which ended early."""
    path(StageCache(tmp_path))
    ended = StageCache(tmp_path)
    ended.until = "double"
    with pytest.raises(StageReached):
        path(ended, gain=3.0)
    with pytest.raises(StorageError, match="of another run"):
        path(ArchiveCache(tmp_path), gain=gain)
    path(StageCache(tmp_path), gain=3.0)
    path(ArchiveCache(tmp_path), gain=3.0)


def test_a_stage_of_another_version_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path(StageCache(tmp_path))
    monkeypatch.setitem(globals(), "TOTAL", Stage(TOTAL.function, 2, True))
    with pytest.raises(StorageError, match="of another polcap"):
        path(ArchiveCache(tmp_path))


def test_a_version_changes_the_key(tmp_path: Path) -> None:
    raised = Stage(DOUBLE.function, 2, True)
    one, two = (DryRunCache(tmp_path).run(s, 3.0, config=Settings()) for s in (DOUBLE, raised))
    assert one.key != two.key


def test_key_follows_the_bytes_of_the_photographs_not_their_place(tmp_path: Path) -> None:
    frame = capture_values.Frame("/a/x.dng", capture_values.Exif(), "shot", "digest")
    capture = capture_values.Capture(
        "a", "/a", (capture_values.Shot(0.0, (frame,)),), "folders", 1.0, True, (0.0, 0.0), (2, 2), notes=("n",)
    )
    elsewhere = capture_values.Shot(0.0, (replace(frame, path="/b/x.dng"),))
    moved = replace(capture, folder="/b", name="b", shots=(elsewhere,))
    other = replace(capture, shots=(capture_values.Shot(0.0, (replace(frame, digest="other"),)),))
    turned = replace(capture, shots=(capture_values.Shot(0.1, (frame,)),))
    key = [DryRunCache(tmp_path).run(DOUBLE, c, config=Settings()).key for c in (capture, moved, other, turned)]
    assert key[0] == key[1] and len(set(key)) == 3


def test_only_facts_that_change_pixels_enter_the_key() -> None:
    """For a new field: mark it NOT_IN_KEY, or list it here, if the same photographs give another result with it."""
    capture = {"shots", "layout", "focal_px", "focal_known", "principal_px", "size_px", "chart_frames", "crossed"}
    capture |= {"calibration", "angles"}  # advice on the angles is stored with the merged pictures
    frame = {"exif", "role", "digest", "exposure"}
    for kind, expected in ((capture_values.Capture, capture), (capture_values.Frame, frame)):
        assert {one.name for one in fields(kind) if one.metadata.get("in_key", True)} == expected


def test_force_computes_the_stage_and_what_follows(tmp_path: Path) -> None:
    path(StageCache(tmp_path))
    for force, computed in (("double", ["double", "passing", "total"]), ("total", ["passing", "total"])):
        calls.clear()
        path(StageCache(tmp_path, force=force))
        assert calls == computed


@pytest.mark.parametrize("harm", ["flip", "truncate", "remove"])
def test_damaged_result_is_noticed_and_computed_again(tmp_path: Path, harm: str) -> None:
    path(StageCache(tmp_path))
    file = tmp_path / "work" / "01-double" / "value.array.npy"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    if harm == "remove":
        file.unlink()
    else:
        file.write_bytes(data if harm == "flip" else data[:100])
    calls.clear()
    assert float(path(StageCache(tmp_path)).double.value.array[0, 0]) == 6.0
    assert calls == ["double", "passing"]


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
    path(StageCache(tmp_path))
    place = tmp_path / "work" / "01-double"
    edited(place / "manifest.json", old, new)
    with pytest.raises(StorageError, match=r"run `polcap process`"):
        path(ArchiveCache(tmp_path))
    calls.clear()
    assert path(StageCache(tmp_path)).double.value.shift == (3.0, 0.0)
    assert calls == ["double", "passing"]


@pytest.mark.parametrize("seconds", ["long", None, -1, {"a": 1}])
def test_a_stage_whose_seconds_are_no_number_is_computed_again(tmp_path: Path, seconds: Any) -> None:
    path(StageCache(tmp_path))
    file = tmp_path / "work" / "01-double" / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "seconds": seconds}))
    assert [about["stage"] for about in contents(tmp_path)] == ["total"]  # for `polcap status`
    path(StageCache(tmp_path))
    assert calls == ["double", "passing", "total", "double", "passing"]


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


def test_two_processes_never_work_in_one_folder(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from polcap.pipeline import result_folder\n"
        "with result_folder.locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(StorageError, match=f"process {other.pid} is working"), result_folder.locked(tmp_path):
            pass
    finally:
        other.kill()
        other.wait()
    with result_folder.locked(tmp_path):  # of a dead process: taken over
        pass


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_cache import StageCache, path, result_folder
cache = StageCache(Path(sys.argv[1]))
print("ready", flush=True)
with result_folder.locked(Path(sys.argv[1])):
    path(cache)
"""


def test_killed_stage_leaves_no_half_result_and_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    path(StageCache(whole))
    random = np.random.default_rng(1)
    for attempt in range(3):
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
        with result_folder.locked(folder):
            path(StageCache(folder))
        assert snapshot(folder) == snapshot(whole)


@pytest.mark.parametrize(("number", "word"), [(28, "disk is full"), (30, "read-only"), (13, "permission")])
def test_a_disk_that_refuses_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, word: str
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(StorageError, match=word) as caught:
        path(StageCache(tmp_path))
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


@pytest.mark.parametrize("listed", [("pol000", "pol045", "pol090"), ("0 Grad", "45 Grad", "90 Grad")])
def test_a_result_folder_is_refused_inside_every_kind_of_angle_folder(tmp_path: Path, listed: tuple[str, ...]) -> None:
    for name in listed:
        (tmp_path / name).mkdir()
    with pytest.raises(SettingError, match="lies among the capture's shots"):
        result_place.check(tmp_path / listed[1] / "out", tmp_path)
    result_place.check(tmp_path / "out", tmp_path)
    result_place.check(tmp_path / "new" / "out", tmp_path / "new")  # a capture that does not exist is refused elsewhere


def test_a_digest_is_compared_once_per_process_until_its_file_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path(StageCache(tmp_path))
    compared: list[str] = []

    def noted(file: Path) -> list[Any]:
        compared.append(file.name)
        return checksum(file)

    monkeypatch.setattr(npy_folder, "checksum", noted)
    path(StageCache(tmp_path))
    once = list(compared)
    path(StageCache(tmp_path))
    assert len(once) == 2 and compared == once
    (array,) = (tmp_path / "work" / "01-double").glob("*.npy")
    os.utime(array, ns=(0, 0))
    path(StageCache(tmp_path))
    assert compared[2:] == [array.name]


def test_a_lazy_cache_reports_each_stage_once_in_the_order_of_the_path(tmp_path: Path) -> None:
    seen: list[tuple[str, bool]] = []
    cache = LazyCache(tmp_path, lambda stage, seconds, cached: seen.append((stage, seconds is None)))
    assert path(cache).total.value is not None
    assert seen == [(stage, begins) for stage in ("double", "passing", "total") for begins in (True, False)]


def test_a_lazy_cache_reads_and_computes_nothing_before_a_stored_result(tmp_path: Path) -> None:
    expected = path(StageCache(tmp_path)).total.value
    calls.clear()
    made = path(LazyCache(tmp_path))
    assert calls == [] and keys(made) == keys(path(DryRunCache(tmp_path)))
    shutil.rmtree(tmp_path / "work" / "01-double")
    np.testing.assert_array_equal(made.total.value.array, expected.array)
    assert calls == [] and not (tmp_path / "work" / "01-double").exists()
    shutil.rmtree(tmp_path / "work" / "03-total")
    np.testing.assert_array_equal(path(LazyCache(tmp_path)).total.value.array, expected.array)
    assert calls == ["double", "passing", "total"]
    assert sorted(folder.name for folder in (tmp_path / "work").iterdir()) == ["01-double", "03-total"]


def test_a_stage_is_computed_again_after_a_change_of_a_stage_that_it_uses(tmp_path: Path) -> None:
    def run(version: int) -> None:
        used = Stage(DOUBLE.function, version, True)
        StageCache(tmp_path).run(Stage(TOTAL.function, 1, True, uses=(used,)), everything().inner, None)

    for version, computed in ((1, 1), (1, 1), (2, 2)):
        run(version)
        assert calls == ["total"] * computed
