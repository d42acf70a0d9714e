"""READ FIRST. The path of a flat sample, one line per stage: from the Stokes parameters of its views to its maps.

`stokes_view.py` makes the Stokes parameters of each view, `material_session.py` the poses. Each stage is in the module
of its name in this folder. `cache.run` finds a stored result, or computes it.
"""

from dataclasses import dataclass

import msgspec

from polcap import config as settings_
from polcap.config import Config, Setting
from polcap.fusion.fusion_path import SessionConfig
from polcap.material import coarse_relief, flash_light, gloss_groups, height_map, rectification, texel_maps, tiling
from polcap.material.coarse_relief import CoarseRelief, ReliefSettings
from polcap.material.flash_light import ChartInView
from polcap.material.gloss_groups import GlossGroups, GlossSettings
from polcap.material.height_map import MaterialMaps
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_grid import FlashLight, TexelGrid
from polcap.material.texel_maps import TexelMaps
from polcap.optics.board import Board
from polcap.pipeline.cache import MemoryCache, StageResult
from polcap.quality.limits import MaterialGateLimits

_PAPER_SIGMA, _CHART_SIGMA = 0.1, 0.02  # relative 1σ of the paper's albedo, and of the light on a chart


class SampleSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a material: a section for each stage with settings, and one for the gates."""

    relief: ReliefSettings = ReliefSettings()
    gloss: GlossSettings = GlossSettings()
    gates: MaterialGateLimits = MaterialGateLimits()


class MaterialConfig(Config, frozen=True, forbid_unknown_fields=True):
    """Settings of `polcap material`: those of its views, and in the section `material` those of the sample."""

    material: SampleSettings = SampleSettings()


def all_settings() -> list[Setting]:
    """The settings of all commands: of single captures, of `polcap fuse` and of `polcap material`."""
    own = [one for one in settings_.settings(MaterialConfig) if one.key.startswith("material.")]
    return [*settings_.settings(SessionConfig), *own]


@dataclass(frozen=True)
class MaterialResults:
    """Results of the stages that reports need, and the cache keys."""

    light: FlashLight
    relief: CoarseRelief
    gloss: GlossGroups
    fitted: TexelMaps
    maps: MaterialMaps
    keys: dict[str, str]


def path(
    views: StageResult[tuple[PosedStokes, ...]],
    chart: ChartInView | None,
    board: Board,
    grid: TexelGrid,
    settings: SampleSettings,
    tile: bool,
    cache: MemoryCache,
) -> MaterialResults:
    """Run the stages in order.

    Raises CaptureError: too little of board or sample is visible.
    """
    light = cache.run(flash_light.measure, views, chart, board)
    relief = cache.run(coarse_relief.solve, views, light, grid, config=settings.relief)
    stokes = cache.run(rectification.rectify, views, light, relief, grid)
    gloss = cache.run(gloss_groups.find, views, light, relief, grid, stokes, config=settings.gloss)
    fitted = cache.run(texel_maps.estimate, views, light, relief, grid, stokes, gloss, config=settings.gloss)
    maps = cache.run(height_map.build, fitted, relief, grid, cache.derive(albedo_sigma, chart))
    if tile:
        maps = cache.run(tiling.tile, maps)
    keys = {name: result.key for name, result in cache.results.items()}
    return MaterialResults(light.value, relief.value, gloss.value, fitted.value, maps.value, keys)


def albedo_sigma(chart: ChartInView | None) -> float:
    """Relative 1σ of the scale of all albedos: of the paper's albedo, or of the light that reaches the chart."""
    return _PAPER_SIGMA if chart is None else _CHART_SIGMA
