"""Every setting of `polcap fuse` changes the fused object or its report, or is refused."""

from collections.abc import Callable
from typing import Any

import pytest

from polcap import config as configs
from polcap.config import Setting
from polcap.errors import SettingError
from polcap.fusion import atlas as atlases
from polcap.fusion import baking, filling, fusion_path, view_path
from polcap.fusion.baking import BakingSettings
from polcap.fusion.fused_maps import FusedSource
from polcap.fusion.fusion_path import SessionConfig
from polcap.fusion.view_path import SessionView
from polcap.pipeline.cache import LazyCache, MemoryCache, StageResult
from polcap.pipeline.path import UserInput
from polcap.quality import fused_object
from polcap.quality.fused_object import SeenSurface
from tests.fusion import board_views, ellipsoid

SETTINGS = list(configs.settings(SessionConfig))
REFUSED = {setting.key for setting in SETTINGS if setting.key.startswith(tuple(fusion_path.WITHOUT_EFFECT))}


def another(setting: Setting) -> str:
    """An allowed value of a setting that is not its default, as after --set."""
    texts = {"whitebalance.chart": "sg", "whitebalance.chart_width_m": "0.2", "surface.back": "skirt"}
    if setting.key in texts:
        return texts[setting.key]
    if isinstance(setting.default, bool):
        return str(not setting.default).lower()
    if setting.kind.startswith("Literal"):
        choices = [choice.strip("'") for choice in setting.kind.removeprefix("Literal[").strip("]").split(", ")]
        return next(choice for choice in choices if choice != str(setting.default))
    numbers = (setting.default + 1, setting.default - 1, setting.default / 2, setting.default + 0.01)
    for number in numbers:
        try:
            value = int(number) if isinstance(setting.default, int) else number
            configs.fill(SessionConfig, {}, [f"{setting.key}={value}"])
        except SettingError:
            continue
        if value != setting.default:
            return str(value)
    raise AssertionError(setting)


class KeyCache(MemoryCache):
    """Computes keys only; every result is empty."""

    def _value(self, *_: Any) -> Any:
        return ()


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Callable[[SessionConfig], list[Any]]:
    """What a fusion makes with some settings: keys of its stages, gates, and the factors of its material."""
    work = tmp_path_factory.mktemp("work")
    atlas = atlases.chart(ellipsoid.mesh(), 64, 2)
    maps = filling.fill(baking.bake(ellipsoid.views(3), atlas, BakingSettings()), atlas)

    def make(config: SessionConfig) -> list[Any]:
        config.check()
        view = SessionView("view01", board_views.capture(), UserInput(), config.of_views, work)
        of_view = view_path.path(view, LazyCache(work))
        fused = fusion_path.path(StageResult("", ()), config.fusion, KeyCache())
        limits = config.fusion.gates
        gates = [
            fused_object.views(["view01"], {}, limits),
            fused_object.poses({"view01": 0.1}, True, limits),
            fused_object.poses({"view01": 0.1}, False, limits),
            fused_object.agreement({"view01": 6.0}, limits),
            fused_object.join("setB", 0.9, limits),
            fused_object.seen(SeenSurface(0.9, 0.0, 0.1, 0.0), 1, limits),
        ]
        built = FusedSource(atlas, maps, config.asset).whole(8, ())
        return [
            of_view.features.key,
            of_view.mask.key,
            fused.keys["comparison"],
            gates,
            view.config.gates,
            built.ior,
            built.specular_factor,
        ]

    return make


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.key)
def test_every_setting_of_a_fusion_acts_or_is_refused(
    setting: Setting, outcome: Callable[[SessionConfig], list[Any]]
) -> None:
    changed = configs.fill(SessionConfig, {}, [f"{setting.key}={another(setting)}"])
    if setting.key in REFUSED:
        words = rf"{setting.key} = .* has no effect on a fused object; .*leave"
        with pytest.raises(SettingError, match=words) as error:
            outcome(changed)
        assert "\n" not in str(error.value)
    else:
        assert outcome(changed) != outcome(SessionConfig())


def test_a_refused_setting_may_have_its_default() -> None:
    configs.fill(SessionConfig, {}, ["mask.part=0", "surface.jump=0.02"]).check()
