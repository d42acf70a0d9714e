"""The ellipsoid's atlas and its maps, for several tests."""

import pytest

from polcap.fusion import atlas as atlases
from polcap.fusion import baking
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, BakingSettings
from tests.fusion import ellipsoid


@pytest.fixture(scope="session")
def atlas() -> Atlas:
    return atlases.chart(ellipsoid.mesh(), 256, 6)


@pytest.fixture(scope="session")
def baked(atlas: Atlas) -> AtlasMaps:
    return baking.bake(ellipsoid.views(8), atlas, BakingSettings())
