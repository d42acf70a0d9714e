"""After any fault the run ends in time, no frame is lost, no angle is wrong, and `--resume` completes the capture."""

from pathlib import Path

import pytest

from tests.rig import faults
from tests.rig.far_end import Device
from tests.rig.pool import Key


@pytest.mark.parametrize("fault", faults.CLASSES)
def test_a_fault_costs_no_frame_and_the_capture_is_completed(
    fault: str, pool: dict[Key, bytes], tmp_path: Path
) -> None:
    outcome = faults.trial(fault, 0, pool, tmp_path / "capture")
    assert outcome.accepted + outcome.retaken == 15


@pytest.mark.parametrize("kind", faults.KINDS)
def test_every_rotator_shoots_a_whole_capture(kind: type[Device], pool: dict[Key, bytes], tmp_path: Path) -> None:
    faults.undisturbed(kind, pool, tmp_path / "capture")
