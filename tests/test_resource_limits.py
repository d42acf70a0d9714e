"""Limits that no system can set are reported at once, on one line."""

from pathlib import Path

import pytest

from polcap import resource_limits
from polcap.config import Config
from polcap.errors import ModelError, SettingError
from polcap.formats.capture.reader import read as read_capture
from polcap.optics import registration
from polcap.pipeline import run as pipeline
from polcap.pipeline.path import UserInput
from polcap.stages.hdr import planes
from tests.conftest import Command


@pytest.mark.parametrize("gigabytes", [float("inf"), float("nan"), 1e300, -1.0])
def test_what_is_no_amount_of_memory_is_refused(gigabytes: float) -> None:
    with pytest.raises(SettingError, match="--memory"):
        resource_limits.set_limits(0, gigabytes)


def test_less_than_any_capture_needs_is_refused_with_what_it_takes() -> None:
    """Below, allocations fail in whatever library asks first, and some of those wait for ever."""
    with pytest.raises(SettingError, match=r"--memory 0.4: .* 0.8 GB"):
        resource_limits.check_memory(0.4)
    resource_limits.check_memory(0.8)


def test_a_batch_says_so_before_any_capture(tmp_path: Path, polcap: Command) -> None:
    (tmp_path / "obj" / "pol000").mkdir(parents=True)
    done = polcap("batch", tmp_path, "--memory", "inf")
    assert done.returncode == 2 and "--memory inf" in done.stderr
    assert not (tmp_path / "polcap-batch").exists()


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ValueError("OpenCV(5.0.0) alloc.cpp: error: (-4:Insufficient memory) Failed to allocate 15360000 bytes in f"),
        RuntimeError("[ONNXRuntimeError] : Failed to allocate memory for requested buffer of size 42467328"),
    ],
)
def test_a_lack_of_memory_is_known_by_whoever_says_it(error: Exception) -> None:
    wrapped = ModelError("model.onnx failed")
    wrapped.__cause__ = error
    assert resource_limits.is_shortfall(error) and resource_limits.is_shortfall(wrapped)
    assert not resource_limits.is_shortfall(ModelError("model.onnx failed"))


def test_a_lack_of_memory_names_the_stage_what_it_would_take_and_the_remedy(
    example: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def register(*_: object) -> None:
        raise MemoryError("Unable to allocate 3.00 GiB for an array with shape (3, 8) and data type float32")

    monkeypatch.setattr(planes, "process_memory", lambda: (2_000_000_000, 4_000_000_000))
    monkeypatch.setattr(registration, "register", register)
    capture = read_capture(example)
    with pytest.raises(SettingError) as caught:
        pipeline.process(capture, UserInput(), Config(), tmp_path, until="align")
    message = str(caught.value)
    assert message.startswith("align: out of memory with 2.00 GB used and 3.2 GB more requested; a capture of 0.995 MP")
    assert message.endswith("takes about 5.8 GB in all: raise --memory from 4 to that, or leave it out")


def test_without_a_limit_the_remedy_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planes, "process_memory", lambda: (0, None))
    message = str(resource_limits.shortfall(MemoryError(), "surface", 24_000_000))
    assert message.startswith("surface: out of memory; a capture of 24 MP takes about 1.9 GB in all: free that much")
