"""Place of the flash and light of each view from rendered boards on matt and on glossy paper."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from msgspec import UNSET, UnsetType

from polcap.material import flash_light
from polcap.quality import flat_sample
from polcap.quality.limits import MaterialGateLimits
from polcap.synth.distance_fields import Cluster
from polcap.synth.laid_board import LaidBoard
from tests.fusion.board_views import BOARD, picture, pose, scene
from tests.material.test_board_focus import seen

FLASH = (0.01, 0.05, 0.0)
PEA = Cluster(((0, 0, 0, 0.004),))


@pytest.mark.parametrize("roughness", [UNSET, 0.3])
def test_matt_and_glossy_paper_give_the_same_light(roughness: float | UnsetType) -> None:
    poses = [pose(20.0, 88.0), pose(70.0, 68.0), pose(160.0, 68.0), pose(250.0, 50.0), pose(340.0, 50.0)]
    views, irradiance = [], []
    for at in poses:
        made = scene(at, PEA, shift=np.array([0.0, -0.026, 0.0]))
        assert isinstance(made.board, LaidBoard)
        board = msgspec.structs.replace(made.board, roughness=roughness)
        made = msgspec.structs.replace(made, board=board, light=FLASH)
        views.append(replace(seen(picture(made)), pose=at))
        irradiance.append(float(np.sum((np.array(FLASH) - made.position) ** 2)))  # at 1 m
    light = flash_light.measure(tuple(views), None, BOARD)
    assert light.place == pytest.approx(FLASH, abs=0.006)
    assert light.gain == pytest.approx(np.array(irradiance), rel=0.006)
    gate = flat_sample.paper(light.shine, MaterialGateLimits())
    assert gate.state == ("pass" if roughness is UNSET else "warn") and bool(gate.remedy) == (gate.state == "warn")
