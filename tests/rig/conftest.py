"""Fixtures of several rig tests."""

import pytest

from tests.rig.pool import Key, photographs


@pytest.fixture(scope="session")
def pool() -> dict[Key, bytes]:
    """Photographs of a small scene at every angle and exposure."""
    return photographs(width=96, height=72)
