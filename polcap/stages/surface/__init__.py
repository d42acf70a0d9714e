"""Stage 9: depth and mesh, integrated from the normals.

A pixel (i, j) at depth d along the optical axis is at the point d·(a, b, −1), with a = (i − cx)/f, b = −(j − cy)/f.
The unknown is the scaled log depth z = f ln d; one unit of z is about one pixel of depth. The normal n is perpendicular
to the surface. With m = n_z − a n_x − b n_y this gives the slope equations m ∂z/∂i = n_x and m ∂z/∂j = −n_y, which are
linear in z.

    slope_equations   normals, weights and coefficients of these equations, on a pyramid of grids
    pyramid_level     least-squares equations on one grid, and their solution
    multigrid         solver of the sparse linear systems
    integration       from coarse to fine: where the surface is cut, and its depth
    occlusion         detection of places where one part hides another
    triangles         mesh from the depth
    decimation        meshes with fewer triangles
"""

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import ObjectError
from polcap.image_values import Floats
from polcap.mesh_values import ReliefMesh
from polcap.optics.projection import back_project
from polcap.optics.vertex_frames import vertex_frames
from polcap.stage_values import SurfaceMaps
from polcap.stages import stage
from polcap.stages.surface import triangles
from polcap.stages.surface.decimation import DecimatedMesh, decimate
from polcap.stages.surface.integration import log_depth
from polcap.stages.surface.slope_equations import normal_field
from polcap.stages.surface.triangles import Back

__all__ = ["Back", "DecimatedMesh", "SurfaceSettings", "decimate", "integrate", "triangulate"]


class SurfaceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `surface`, the section `surface` of a settings file."""

    stiffness: Annotated[
        float, Meta(ge=0.0, le=20.0, description="tendency to cut at depth steps; 0: plain least squares [1]")
    ] = 2.0
    iterations: Annotated[
        int, Meta(ge=1, le=200, description="greatest number of reweightings on the grid that decides on depth steps")
    ] = 25
    tolerance: Annotated[
        float, Meta(ge=1e-8, le=0.1, description="relative change of the energy that ends the reweightings [1]")
    ] = 1e-3
    steepest_deg: Annotated[
        float, Meta(ge=45.0, le=89.0, description="greatest tilt of a normal from the camera; more is capped [degrees]")
    ] = 84.0
    prior_weight: Annotated[
        float, Meta(ge=0.0, le=1000.0, description="weight of the network's coarse depth against the normals [1]")
    ] = 0.15
    jump: Annotated[
        float, Meta(ge=0.002, le=1.0, description="least depth step that cuts the mesh, over the object's radius [1]")
    ] = 0.02
    max_vertices: Annotated[
        int, Meta(ge=1000, le=10_000_000, description="most vertices of the mesh, on a regular grid of pixels")
    ] = 250_000
    back: Annotated[
        Back, Meta(description="behind the front: nothing, walls (skirt), or walls and a flat back (closed)")
    ] = "open"


@stage(version=15)
def integrate(maps: SurfaceMaps, distance_m: float | None, settings: SurfaceSettings) -> ReliefMesh:
    """Integrate normals to the visible surface of the object: depth and mesh.

    The median depth is `distance_m`, the object's distance along the optical axis [m], or 1 where it is unknown.

    Raises ObjectError: the mask has fewer than 16 pixels, or not one of them has a neighbor.
    """
    count = int(maps.mask.sum())
    if count < 16:
        raise ObjectError(f"the mask holds {count} pixels, under 16; mark the object with --mask")
    field = normal_field(maps, np.radians(settings.steepest_deg), settings.prior_weight)
    z = log_depth(field, settings.stiffness, settings.iterations, settings.tolerance, settings.jump)
    depth = np.full(maps.mask.shape, np.nan)
    depth[maps.mask] = np.exp((z - np.median(z)) / maps.view.focal)
    depth *= 1.0 if distance_m is None else distance_m
    return triangulate(depth.astype(np.float32), maps, distance_m is not None, settings)


def triangulate(depth: Floats, maps: SurfaceMaps, metric: bool, settings: SurfaceSettings) -> ReliefMesh:
    """Make the mesh of a depth map (H, W) in float32, NaN outside the object; `metric`: depths are in metres.

    Of the maps only mask, normals and camera are used. maps/ stores them and the depth exactly, so the mesh can be made
    again from there.

    Raises ObjectError: no triangle fits into the mask.
    """
    height, width = maps.mask.shape
    mask = maps.mask & np.isfinite(depth)
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / settings.max_vertices))))
    z = maps.view.focal * np.log(np.where(mask, depth, 1.0))
    field = normal_field(replace(maps, mask=mask), np.radians(settings.steepest_deg), 0.0)
    pixel, faces = triangles.grid_triangles(z, triangles.unbroken_links(z, field, settings.jump), step)
    if len(faces) == 0:
        raise ObjectError("the mask holds no two neighboring rows and columns; mark the object with --mask")
    figures = triangles.measure_boundary(pixel, faces, mask, step)
    x, y = pixel.T
    place, z_smooth = triangles.smooth_boundary(pixel.astype(np.float64), z[y, x], faces, step)
    vertices = back_project(maps.view, place[:, 0], place[:, 1]) * np.exp(z_smooth / maps.view.focal)[:, None]
    uv: Floats = (place + 0.5) / [width, height]
    normals, tangents = vertex_frames(vertices, uv, faces)
    mesh = ReliefMesh(
        vertices=vertices,
        normals=normals,
        uv=uv,
        tangents=tangents,
        faces=faces,
        depth=np.where(mask, depth, np.nan).astype(np.float32),
        metric=metric,
        pieces=figures.pieces,
        cuts=figures.cuts,
        cut_px=figures.cut_px,
        raggedness=figures.raggedness,
    )
    return triangles.to_float32(triangles.add_back(mesh, settings.back))
