"""The asset that the exports are tested with."""

import pytest

from polcap.mesh_values import Asset
from tests import surfaces


@pytest.fixture(scope="session")
def asset() -> Asset:
    maps = surfaces.maps(ripple=0.1, roughness=0.5, specular=0.05)
    return surfaces.built(maps, surfaces.mesh(maps))
