"""Fixtures of several rig tests."""

from collections.abc import Iterator

import pytest

from tests.clocks import SleepClock
from tests.rig import virtual
from tests.rig.pool import Key, photographs


@pytest.fixture(scope="session")
def pool() -> dict[Key, bytes]:
    """Photographs of a small scene at every angle and exposure."""
    return photographs(width=96, height=72)


@pytest.fixture
def clock() -> Iterator[SleepClock]:
    """Virtual time of the rig's ports and motors."""
    with virtual.time() as clock:
        yield clock
