"""Shape of the object: several views' masks and normals to one closed mesh."""

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from polcap.fusion.carving import carve
from polcap.fusion.closed_mesh import iso_surface, solid
from polcap.fusion.hull import visual_hull
from polcap.fusion.normal_surface import fit_normals
from polcap.fusion.small_views import reduce_views
from polcap.fusion.values import ClosedMesh, FusionView
from polcap.stages import stage

_ROUNDS = 20  # of the surface's fit; docs/benchmarks/fusion-choices.md
_FIRST_ROUNDS = 6  # before hollows are searched: on the bare hull views disagree at flat hollows, too


class ShapeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `shape` of the fusion."""

    grid: Annotated[int, Meta(ge=40, le=300, description="steps along the object's longest side")] = 140


@stage(version=11)
def fuse_shape(views: Sequence[FusionView], settings: ShapeSettings) -> ClosedMesh:
    """Join views of one object into a closed, manifold, outward mesh in the world frame.

    Raises ObjectError: the silhouettes have no point in common, or enclose no body.
    """
    small = reduce_views(views)
    hull = visual_hull(small, settings.grid)
    surface = fit_normals(iso_surface(hull), small, hull, _FIRST_ROUNDS)
    surface = fit_normals(iso_surface(carve(hull, surface, small)), small, hull, _ROUNDS)
    return solid(surface.mesh, floor=0.0)  # views from above do not bound the object below the board
