"""Limits that no system can set are told at once, on one line."""

from pathlib import Path

import pytest

from polcap import resource_limits
from polcap.errors import SettingError
from tests.conftest import Command


@pytest.mark.parametrize("gigabytes", [float("inf"), float("nan"), 1e300, -1.0])
def test_what_is_no_amount_of_memory_is_refused(gigabytes: float) -> None:
    with pytest.raises(SettingError, match="--memory"):
        resource_limits.set_memory(gigabytes)


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
