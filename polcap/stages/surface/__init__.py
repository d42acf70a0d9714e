"""Stage 9: integrate normals to depth, and cut the depth map into a mesh.

A pixel (i, j) at distance d along the optical axis sits at d·(a, b, −1), a = (i − cx)/f,
b = −(j − cy)/f. Its normal n is square to the surface, so with z = f ln d and
m = n_z − a n_x − b n_y the slopes obey m ∂z/∂i = n_x and m ∂z/∂j = −n_y: linear in z, and
scaled so that one unit of z is about one pixel of depth.

`integration` solves for z, `jumps` tells where one part hides another, `triangles` makes the mesh.
"""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import ObjectError
from polcap.images import Floats, Mesh, SurfaceMaps
from polcap.stages import stage
from polcap.stages.surface import triangles
from polcap.stages.surface.backing import Back
from polcap.stages.surface.decimation import Decimated, decimated
from polcap.stages.surface.integration import log_depth
from polcap.stages.surface.slope_equations import problem

__all__ = ["Back", "Decimated", "Settings", "decimated", "integrate", "triangulate"]


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `surface` of a settings file."""

    stiffness: Annotated[
        float,
        Meta(ge=0.0, le=20.0, description="how firmly depth jumps are kept; 0 = plain least squares [1]"),
    ] = 2.0
    iterations: Annotated[
        int, Meta(ge=1, le=200, description="reweightings on the grid that decides on jumps, at most")
    ] = 25
    tolerance: Annotated[
        float, Meta(ge=1e-8, le=0.1, description="relative change of the energy that ends them [1]")
    ] = 1e-3
    steepest_deg: Annotated[
        float,
        Meta(ge=45.0, le=89.0, description="normals leaning farther from the camera are capped [degrees]"),
    ] = 84.0
    prior_weight: Annotated[
        float,
        Meta(ge=0.0, le=1000.0, description="pull of the coarse depth on the whole surface, against its stiffness [1]"),
    ] = 0.15
    jump: Annotated[
        float,
        Meta(ge=0.002, le=1.0, description="least depth step that cuts the mesh, over the object's radius [1]"),
    ] = 0.02
    max_vertices: Annotated[
        int,
        Meta(ge=1000, le=10_000_000, description="the mesh is thinned to a regular grid under this count"),
    ] = 250_000
    back: Annotated[Back, Meta(description="walls behind the seen side, with or without a flat back to close it")] = (
        "open"
    )


@stage(version=12)
def integrate(maps: SurfaceMaps, distance_m: float | None, settings: Settings) -> Mesh:
    """The visible surface of the object, from its normals.

    `distance_m` is the distance of the object along the optical axis [m], which becomes the median
    depth; without it the median depth is 1.

    Raises
    ------
    ObjectError
        Fewer than 16 pixels in the mask, or not one of them has a neighbour.
    """
    count = int(maps.mask.sum())
    if count < 16:
        raise ObjectError(f"the mask holds {count} pixels, under 16; mark the object with --mask")
    z = log_depth(
        problem(maps, np.radians(settings.steepest_deg), settings.prior_weight),
        settings.stiffness,
        settings.iterations,
        settings.tolerance,
        settings.jump,
    )
    depth = np.full(maps.mask.shape, np.nan)
    depth[maps.mask] = np.exp((z - np.median(z)) / maps.view.focal)
    depth *= 1.0 if distance_m is None else distance_m
    return triangulate(depth, maps, distance_m is not None, settings)


def triangulate(depth: Floats, maps: SurfaceMaps, metric: bool, settings: Settings) -> Mesh:
    """The mesh of a depth map: for an export from stored maps, without integrating again.

    Parameters
    ----------
    depth
        (H, W), in metres or relative.
    maps
        Mask, view and expected errors of the same crop.
    metric
        Whether the depth is in metres.
    settings
        Of the stage.

    Raises
    ------
    ObjectError
        No triangle fits into the mask.
    """
    return triangles.triangulate(
        depth,
        maps,
        metric,
        np.radians(settings.steepest_deg),
        settings.jump,
        settings.max_vertices,
        settings.back,
    )
