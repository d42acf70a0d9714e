"""READ SECOND, after `view_path.py`. The path of a session, one line per stage: from maps of views to textures.

`view_path.py` makes the maps of each view, `session.py` the poses. Each stage is in the module of its name in this
folder; `shape` uses five more. The docstring of the package lists all modules. `cache.run` finds a stored
result, or computes it, as for a single capture (`pipeline/path.py`).
"""

from dataclasses import dataclass

import msgspec

from polcap import config as settings_
from polcap.config import Config
from polcap.errors import SettingError
from polcap.fusion import atlas, baking, comparison, filling, joining, material_fit, shape
from polcap.fusion.atlas import Atlas, AtlasSettings
from polcap.fusion.baking import AtlasMaps, BakingSettings
from polcap.fusion.comparison import Comparison
from polcap.fusion.joining import JoinedSet
from polcap.fusion.material_fit import MaterialSettings
from polcap.fusion.shape import ShapeSettings
from polcap.fusion.values import ClosedMesh, FusionView
from polcap.pipeline.cache import MemoryCache, StageResult
from polcap.quality.limits import FusedGateLimits

# settings of `polcap process` that would not change a fused object, by the beginning of their keys
WITHOUT_EFFECT = {
    "surface.": "its mesh is of all views: set fusion.shape.grid",
    "mask.part": "it is the largest part of the masks of all views",
    "asset.raw_pixels": "its textures are means of all views: set fusion.atlas.size",
}


class FusionSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the fusion: a section for each stage with settings, and one for the gates."""

    shape: ShapeSettings = ShapeSettings()
    atlas: AtlasSettings = AtlasSettings()
    baking: BakingSettings = BakingSettings()
    material_fit: MaterialSettings = MaterialSettings()
    gates: FusedGateLimits = FusedGateLimits()


class SessionConfig(Config, frozen=True, forbid_unknown_fields=True):
    """Settings of `polcap fuse`: those of its views, and in the section `fusion` those of the fusion."""

    fusion: FusionSettings = FusionSettings()

    def check(self) -> None:
        """Refuse settings that would not change a fused object.

        Raises SettingError: one of them differs from its default.
        """
        for setting in settings_.settings(Config):
            section, name = setting.key.split(".")
            value = getattr(getattr(self, section), name)
            reason = next((why for key, why in WITHOUT_EFFECT.items() if setting.key.startswith(key)), None)
            if reason and value != setting.default:
                raise SettingError(
                    f"{setting.key} = {value} has no effect on a fused object; {reason}, and leave this one out"
                )


@dataclass(frozen=True)
class FusionResults:
    """One value per stage, and the cache keys."""

    joined: tuple[JoinedSet, ...]  # sets of views after the first
    mesh: ClosedMesh
    atlas: Atlas
    maps: AtlasMaps
    comparison: Comparison
    keys: dict[str, str]


def path(views: StageResult[tuple[FusionView, ...]], settings: FusionSettings, cache: MemoryCache) -> FusionResults:
    """Run the stages in order.

    Raises CaptureError: a set of views does not show the object of the first one.
    """
    joined = cache.run(joining.join, views)
    joining.require_shared(joined.value, settings.gates.min_shared)
    placed = cache.derive(joining.place, views, joined)
    mesh = cache.run(shape.fuse_shape, placed, config=settings.shape)
    atlas_ = cache.run(atlas.unwrap, mesh, placed, config=settings.atlas)
    baked = cache.run(baking.bake, placed, atlas_, config=settings.baking)
    fitted = cache.run(material_fit.fit, placed, atlas_, baked, config=settings.material_fit)
    maps = cache.run(filling.fill, fitted, atlas_)
    compared = cache.run(comparison.compare, placed, atlas_, maps)
    keys = {name: result.key for name, result in cache.results.items()}
    return FusionResults(joined.value, mesh.value, atlas_.value, maps.value, compared.value, keys)
