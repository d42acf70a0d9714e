"""Each stage makes its stored output of its stored input; a stage that does not has a new version."""

import pkgutil
from functools import cache, partial
from typing import Any

import numpy as np
import onnxruntime
import pytest

from polcap import stages
from polcap.formats import onnx
from tests import golden

NAMES = list(golden.LIMITS)


@cache
def made(name: str, threads: int = 1) -> golden.Arrays:
    """All outputs of a stage on its stored inputs, at full size."""
    return golden.outputs(golden.goldens(golden.read(golden.INPUTS), threads)[name].run())


def check(name: str, found: golden.Arrays) -> None:
    changed = golden.differences(name, expected(name), golden.samples(found))
    assert not changed, "\n".join([*changed, golden.REMEDY])


def expected(name: str) -> golden.Arrays:
    arrays = golden.read(golden.file_of(name))
    del arrays["version"]
    return arrays


def test_every_stage_has_a_golden() -> None:
    found = golden.goldens(golden.read(golden.INPUTS))
    folders = {module.name for module in pkgutil.iter_modules(stages.__path__)}
    assert {one.stage.name for one in found.values()} == folders
    assert set(found) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_version_is_that_of_the_golden(name: str) -> None:
    stored = int(golden.read(golden.file_of(name))["version"])
    now = golden.goldens(golden.read(golden.INPUTS))[name].stage.version
    assert now == stored, f"{name}: version {now}, but its golden has version {stored}; run `python -m tests.golden`."


@pytest.mark.parametrize("name", NAMES)
def test_stage_makes_its_stored_output(name: str) -> None:
    check(name, made(name))


@pytest.mark.parametrize("name", ["mask", "infer by network"])
def test_network_makes_the_same_on_two_threads(name: str) -> None:
    check(name, made(name, threads=2))


@pytest.mark.parametrize("name", ["mask", "infer by network"])
def test_network_makes_the_same_without_graph_optimizations(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options = onnxruntime.SessionOptions
    used = []

    def plain() -> Any:
        used.append(options())
        used[-1].graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        return used[-1]

    monkeypatch.setattr(onnxruntime, "SessionOptions", plain)
    onnx._session.cache_clear()
    check(name, made.__wrapped__(name))
    onnx._session.cache_clear()
    assert used


@pytest.mark.parametrize("name", NAMES)
def test_half_a_percent_in_a_patch_is_seen_and_rounding_is_not(name: str) -> None:
    full = made(name)
    stored, rng = golden.samples(full), np.random.default_rng(0)
    rounded = {key: array * (1 + 1e-6 * rng.normal(size=array.shape)) if array.dtype.kind == "f" else array
               for key, array in full.items()}  # fmt: skip
    assert golden.differences(name, stored, golden.samples(rounded)) == []
    for key, array in full.items():
        limit = golden.limit(name, key, array)
        if limit.sensitive or array.dtype.kind == "U" or not np.nan_to_num(array).any():
            continue
        lines = golden.differences(name, stored, golden.samples({**full, key: changed(array, limit.unit)}))
        assert len(lines) == 1 and lines[0].startswith(f"{name}: {key} differs by more than {limit.most:g}"), key


def changed(array: Any, unit: str) -> Any:
    """The array with 0.5 % more in a patch of 32×32 pixels (a fiftieth of a long table), or in its largest number.

    Whole numbers get 2 more or less, bits are inverted, angles get 0.5 % of a radian.
    """
    other = np.array(array)
    if max(other.shape, default=0) > 64:
        half = [max(16, length // 100) for length in other.shape]
        patch: Any = tuple(
            slice(length // 2 - width, length // 2 + width) if length > 64 else slice(None)
            for length, width in zip(other.shape, half)
        )
    else:
        patch = np.unravel_index(np.argmax(np.abs(np.nan_to_num(other))), other.shape)
    part = other[patch]
    if other.dtype == bool:
        other[patch] = ~part
    elif other.dtype.kind in "iu":
        other[patch] = part + 2 if np.all(part < 100) else part - 2
    else:
        other[patch] = part + 0.005 if unit == "degrees" else part * 1.005
    return other


def test_failure_names_stage_array_amount_limit_and_remedy() -> None:
    found = {**made("stokes"), "stokes": made("stokes")["stokes"] * 1.02}
    with pytest.raises(AssertionError) as failure:
        check("stokes", found)
    message = str(failure.value)
    assert "stokes: stokes differs by more than 0.001 (relative) in" in message
    assert "(limit 0.05%)" in message and "largest difference is 0.02" in message
    assert "`python -m tests.golden`" in message


def test_missing_and_new_outputs_are_named() -> None:
    one = {"a": np.ones(3)}
    compare = partial(golden.differences, "align")
    assert compare(one, {}) == ["align: a is no longer an output."]
    assert compare({}, one) == ["align: a is a new output."]
    assert compare(one, {"a": np.ones(4)}) == ["align: a has shape (4,), expected (3,)."]
    assert "differs" in compare(one, {"a": np.array([1, 1, np.nan])})[0]
    assert compare(one, one) == []
