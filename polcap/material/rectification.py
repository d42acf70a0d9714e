"""Stage: Stokes parameters of all views on the texels of the sample's plane, at the heights of its relief."""

from polcap.material import texel_stokes
from polcap.material.coarse_relief import CoarseRelief
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_grid import FlashLight, TexelGrid
from polcap.material.texel_stokes import TexelStokes
from polcap.stages import stage


@stage(version=2)
def rectify(views: tuple[PosedStokes, ...], light: FlashLight, relief: CoarseRelief, grid: TexelGrid) -> TexelStokes:
    """Resample all views on the grid, at the heights of its relief."""
    return texel_stokes.resample(views, light, grid, relief.height, 1)
