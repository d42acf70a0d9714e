"""READ FIRST. The path of a session, one line per stage: from the maps of its views to the textures of a closed mesh.

`session.py` makes the maps and poses of the views. Each stage is in the module of its name in this folder; `shape` uses
five more. The docstring of the package lists all modules.
`cache.run` finds a stored result, or computes it, as for a single capture (`pipeline/path.py`).
"""

from dataclasses import dataclass

import msgspec

from polcap.config import Config
from polcap.fusion import atlas, baking, comparison, filling, joining, material_fit, shape
from polcap.fusion.atlas import Atlas, AtlasSettings
from polcap.fusion.baking import AtlasMaps, BakingSettings
from polcap.fusion.comparison import Comparison
from polcap.fusion.joining import JoinedSet
from polcap.fusion.material_fit import MaterialSettings
from polcap.fusion.shape import ShapeSettings
from polcap.fusion.values import ClosedMesh, FusionView
from polcap.pipeline.cache import MemoryCache, StageResult, digest, fingerprint


class FusionSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the fusion, one section per stage."""

    shape: ShapeSettings = ShapeSettings()
    atlas: AtlasSettings = AtlasSettings()
    baking: BakingSettings = BakingSettings()
    material_fit: MaterialSettings = MaterialSettings()


class SessionConfig(Config, frozen=True, forbid_unknown_fields=True):
    """Settings of `polcap fuse`: those of its views, and in the section `fusion` those of the fusion."""

    fusion: FusionSettings = FusionSettings()

    @property
    def of_views(self) -> Config:
        """The settings of the views."""
        return msgspec.convert(self, Config, from_attributes=True)


@dataclass(frozen=True)
class FusionResults:
    """One value per stage, and the cache keys."""

    joined: tuple[JoinedSet, ...]  # sets of views after the first
    mesh: ClosedMesh
    atlas: Atlas
    maps: AtlasMaps
    comparison: Comparison
    keys: dict[str, str]


def path(views: tuple[FusionView, ...], settings: FusionSettings, cache: MemoryCache) -> FusionResults:
    """Run the stages in order."""
    given = StageResult(digest(fingerprint(views)), views)  # hashed once
    joined = cache.run(joining.join, given)
    placed = cache.derive(joining.place, given, joined)
    mesh = cache.run(shape.fuse_shape, placed, config=settings.shape)
    atlas_ = cache.run(atlas.unwrap, mesh, placed, config=settings.atlas)
    baked = cache.run(baking.bake, placed, atlas_, config=settings.baking)
    fitted = cache.run(material_fit.fit, placed, atlas_, baked, config=settings.material_fit)
    maps = cache.run(filling.fill, fitted, atlas_)
    compared = cache.run(comparison.compare, placed, atlas_, maps)
    keys = {name: result.key for name, result in cache.results.items()}
    return FusionResults(joined.value, mesh.value, atlas_.value, maps.value, compared.value, keys)
