"""A model is used as its metadata state it, or refused with the reason."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.errors import ModelError
from polcap.formats import onnx as formats_onnx
from polcap.formats.onnx import ENCODING, load, run, run_session

onnx = pytest.importorskip("onnx", reason="writing test models needs the extra [train]")
helper, TensorProto = onnx.helper, onnx.TensorProto
METADATA = {"channels": "s1,s2", "encoding": ENCODING, "native_size": "128", "size_multiple": "8", "licence": "CC0-1.0"}
MAP = [1, 2, "h", "w"]  # shape of inputs and outputs


def build(
    path: Path,
    nodes: list[Any],
    tensors: tuple[Any, ...] = (),
    shape: list[Any] = MAP,
    opset: int = 17,
    change: Mapping[str, str] = {},
) -> Path:
    """A model of two channels made of these nodes, with METADATA changed."""
    entry = helper.make_tensor_value_info("input", TensorProto.FLOAT, MAP)
    value = helper.make_tensor_value_info("normal", TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "model", [entry], [value], list(tensors))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
    helper.set_model_props(model, {**METADATA, **change})
    onnx.save(model, path)
    return path


def write(path: Path, change: Mapping[str, str] = {}, opset: int = 17) -> Path:
    """A model with one output, twice its input."""
    return build(path, [helper.make_node("Add", ["input", "input"], ["normal"])], opset=opset, change=change)


def test_a_model_runs_and_states_its_channels_and_the_digest_of_its_file(tmp_path: Path) -> None:
    network = load(write(tmp_path / "m.onnx"), "cpu", 1)
    assert network.channels == ("s1", "s2") and network.metadata["licence"] == "CC0-1.0"
    x = np.random.default_rng(0).normal(size=(1, 2, 8, 16)).astype(np.float32)
    np.testing.assert_array_equal(run(network, x)["normal"], 2 * x)
    assert network.digest != load(write(tmp_path / "other.onnx", {"licence": "MIT"})).digest


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *(({name: ""}, f"does not state {name}") for name in METADATA),
        ({"encoding": "99"}, "encoding 99"),
        ({"size_multiple": "0"}, "size_multiple = '0'"),
        ({"channels": "s1,s2,mask"}, "names 3 channels"),
    ],
)
def test_missing_or_wrong_metadata_is_refused(tmp_path: Path, change: dict[str, str], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        load(write(tmp_path / "m.onnx", change))


@pytest.mark.parametrize("content", [b"", b"not a model", None], ids=["empty", "garbage", "truncated"])
def test_broken_file_is_one_line(tmp_path: Path, content: bytes | None) -> None:
    path = write(tmp_path / "m.onnx")
    path.write_bytes(path.read_bytes()[:60] if content is None else content)
    with pytest.raises(ModelError) as caught:
        load(path)
    assert "\n" not in str(caught.value) and "m.onnx" in str(caught.value)


def test_missing_file_and_too_new_opset(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="give the path of an ONNX model"):
        load(tmp_path / "none.onnx")
    with pytest.raises(ModelError, match="opset"):
        load(write(tmp_path / "m.onnx", opset=99))


def test_wrong_input_is_one_line(tmp_path: Path) -> None:
    network = load(write(tmp_path / "m.onnx"))
    with pytest.raises(ModelError, match=r"shape \(1, 3, 8, 8\)"):
        run(network, np.zeros((1, 3, 8, 8), np.float32))


def test_cuda_is_never_replaced_silently(tmp_path: Path) -> None:
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("this machine's onnxruntime has CUDA")
    path = write(tmp_path / "m.onnx")
    with pytest.raises(ModelError, match="--device cuda"):
        load(path, "cuda")
    x = np.ones((1, 2, 8, 8), np.float32)
    assert (run(load(path, "auto"), x)["normal"] == 2 * x).all()


def endless(path: Path) -> Path:
    """A model that doubles its input for ever."""
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Mul", ["x", "x"], ["y"])],
        "body",
        [value("i", TensorProto.INT64, []), value("go", TensorProto.BOOL, []), value("x", TensorProto.FLOAT, None)],
        [value("on", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, None)],
    )
    loop = helper.make_node("Loop", ["times", "", "input"], ["normal"], body=body)
    times = helper.make_tensor("times", TensorProto.INT64, [], [2**62])
    return build(path, [loop], (times,))


def test_a_model_that_does_not_end_is_refused_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("polcap.formats.onnx._TRIAL_S", 2.0)
    with pytest.raises(ModelError, match="not decoded within 2 s"):
        load(endless(tmp_path / "m.onnx"), "cpu", 1)


def test_a_run_that_does_not_end_is_stopped(tmp_path: Path) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(endless(tmp_path / "m.onnx"))
    with pytest.raises(ModelError, match=r"did not end within 1 s"):
        run_session(session, tmp_path / "m.onnx", np.ones((1, 2, 8, 8), np.float32), limit_s=1.0)


@pytest.mark.parametrize(("power", "shape", "words"), [(-0.5, MAP, "NaN"), (2.0, [2], "is \\(2,\\) for")])
def test_an_answer_that_is_no_map_is_refused(tmp_path: Path, power: float, shape: list[Any], words: str) -> None:
    exponent = helper.make_tensor("exponent", TensorProto.FLOAT, [], [power])
    name = "normal" if len(shape) == 4 else "powers"
    nodes = [helper.make_node("Pow", ["input", "exponent"], [name])]
    if len(shape) == 1:
        nodes.append(helper.make_node("ReduceMean", ["powers"], ["normal"], axes=[0, 2, 3], keepdims=0))
    with pytest.raises(ModelError, match=words):
        load(build(tmp_path / "m.onnx", nodes, (exponent,), shape), "cpu", 1)


def test_metadata_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx", {"licence": "Apache-2.0"})
    path.write_bytes(path.read_bytes().replace(b"Apache-2.0", b"Apache-\xea\x80\xff"))
    with pytest.raises(ModelError, match=r"not text|cannot be run|not a model"):
        load(path)


@pytest.mark.parametrize(("threads", "at_once"), [(1, 1), (2, 2), (16, 4), (0, 3)])
def test_parallel_runs_are_as_many_as_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int, at_once: int
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert load(write(tmp_path / "m.onnx"), "cpu", threads).at_once == at_once


def test_a_file_that_changes_after_it_was_opened_is_refused_where_it_is_opened_again(tmp_path: Path) -> None:
    network = load(write(tmp_path / "m.onnx"))
    formats_onnx._session.cache_clear()  # as in another process
    write(tmp_path / "m.onnx", {"licence": "MIT"})
    with pytest.raises(ModelError, match="changed while polcap was using it"):
        run(network, np.ones((1, 2, 8, 8), np.float32))
